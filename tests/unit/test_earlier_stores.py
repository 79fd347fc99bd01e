"""A data folder of a version before the first release is refused, and nothing in it is changed."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pyrage
import pytest
from typer.testing import CliRunner

from device.clock import SystemClock, VirtualClock
from device.config.head_file import load_head
from device.errors import StoreError
from services.backup.backup_folder import BackupFolder, find_folder
from services.backup.backup_key import SecretKey, key_for_recipients
from services.backup.restore_backup import restore_backup
from services.backup.store_contents import packed
from services.backup.write_backup import MANIFEST, Manifest, write_backup
from services.records import schema
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.command import app
from services.records.read_only_store import opened_store
from services.records.recovery import rebuild_database
from services.records.snapshots import Snapshots
from services.records.store_check import check_store
from services.workshop.power_meter import give_pulses, run_of
from tests.project_files import ROOT

MESSAGE = "was written by a version before the first release, which cannot be read here"
CLOCK = VirtualClock()
IDENTITY = pyrage.x25519.Identity.generate()
KEY = key_for_recipients([str(IDENTITY.to_public())])
SECRET = SecretKey(str(IDENTITY), KEY.secret)


def tables(database: Path, revision: str = "r0006") -> sqlite3.Connection:
    """Return an open connection to a made-up database with that revision, whose rows are in its write-ahead log."""
    connection = sqlite3.connect(database, isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL PRIMARY KEY)")
    connection.execute("INSERT INTO alembic_version VALUES (?)", (revision,))
    connection.execute("CREATE TABLE light_doses (eye TEXT, slot INTEGER, dose_j_per_cm2 REAL)")
    connection.execute("INSERT INTO light_doses VALUES ('OD', 0, 9.5)")
    return connection


def with_tables(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        with closing(tables(folder / name)):
            pass

    return make


KINDS: dict[str, Callable[[Path], None]] = {
    "database": with_tables("shelf.sqlite"),
    "no database": lambda folder: (folder / "torn").mkdir(),
    "copy of the doses": lambda folder: (folder / "light.copy").write_bytes(b"a block"),
    "revision": with_tables(schema.DATABASE),
}


@pytest.fixture(params=KINDS)
def earlier(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a made-up data folder with what every version had, and a mark of its age."""
    folder = tmp_path / "earlier"
    for name in ("captures/20260302T120700-OD-3aa5cf", "patients", "visits"):
        (folder / name).mkdir(parents=True)
    (folder / "captures/20260302T120700-OD-3aa5cf/raw.tiff").write_bytes(b"raw counts")
    (folder / "dose-ledger.log").write_bytes(b"\n00000000 {}\n")
    KINDS[request.param](folder)
    return folder


def content(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return time of change and content of everything in a folder, by path; folders have no content."""
    every = [folder, *sorted(folder.rglob("*"))]
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"") for path in every}


def opened(folder: Path, _: Path) -> None:
    CaptureStore(folder).close()


def served(folder: Path, _: Path) -> None:
    with opened_store(folder, CLOCK):
        pass


def lit(folder: Path, _: Path) -> None:
    run = run_of(load_head(ROOT / "hardware" / "heads" / "sim.toml"), None, 1.0)
    give_pulses(run, folder, CLOCK, pytest.fail)


def backed_up(folder: Path, place: Path) -> None:
    write_backup(folder, place, CLOCK, lambda *_: None, KEY)


ACTIONS: list[Callable[[Path, Path], object]] = [
    opened,
    served,
    lit,
    backed_up,
    lambda folder, _: check_store(folder, str),
    lambda folder, _: rebuild_database(folder),
]


@pytest.mark.parametrize("act", ACTIONS, ids=("open", "serve", "light", "back up", "check", "rebuild"))
def test_an_earlier_store_is_refused_and_not_changed(
    earlier: Path, tmp_path: Path, act: Callable[[Path, Path], object]
) -> None:
    (tmp_path / "stick").mkdir()
    before = content(earlier)
    with pytest.raises(StoreError) as raised:
        act(earlier, tmp_path / "stick")
    assert raised.value.message == f"{earlier} {MESSAGE}"
    assert "Nothing was changed" in raised.value.remedy
    assert content(earlier) == before
    assert not list((tmp_path / "stick").iterdir())


@pytest.mark.parametrize(
    "words", [("list",), ("restore", "r0005-20260302T120000.db", "--yes")], ids=("list", "restore")
)
def test_the_snapshots_of_an_earlier_store_are_refused(earlier: Path, words: tuple[str, ...]) -> None:
    before = content(earlier)
    done = CliRunner().invoke(app, [*words, "--data", str(earlier)])
    assert isinstance(done.exception, StoreError)
    assert done.exception.message == f"{earlier} {MESSAGE}"
    assert content(earlier) == before


def test_an_earlier_snapshot_is_refused(tmp_path: Path) -> None:
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        store.save(Capture("a", "OD", CLOCK.wall(), True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})
    (tmp_path / "snapshots").mkdir()
    with_tables("r0006.db")(tmp_path / "snapshots")
    with pytest.raises(StoreError, match=f"the snapshot r0006.db {MESSAGE}"):
        Snapshots(tmp_path / schema.DATABASE, SystemClock()).restore("r0006.db")
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert [capture.id for capture in store.captures()] == ["a"]


@pytest.mark.parametrize("name", ["shelf.sqlite", schema.DATABASE])
def test_an_earlier_backup_is_refused(tmp_path: Path, name: str) -> None:
    with_tables("old.sqlite")(tmp_path)
    manifest = Manifest(number=1, made_at=CLOCK.wall(), units={})
    files = {MANIFEST: manifest.model_dump_json().encode(), name: tmp_path / "old.sqlite"}
    backups = BackupFolder(tmp_path, KEY)
    backups.add_backup(1, KEY.header.encrypted(KEY.sealed(packed(files))))
    with pytest.raises(StoreError, match=MESSAGE):
        restore_backup(find_folder(tmp_path), SECRET, tmp_path / "new", lambda *_: None)
    with CaptureStore(tmp_path / "new", reserve_bytes=0) as store:
        assert store.captures() == []


def test_earlier_tables_that_only_the_write_ahead_log_holds_are_not_taken_for_newer_ones(tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    with closing(tables(tmp_path / schema.DATABASE)):
        for path in tmp_path.glob(f"{schema.DATABASE}*"):
            (tmp_path / "copy" / path.name).write_bytes(path.read_bytes())
    with pytest.raises(StoreError, match=MESSAGE):
        CaptureStore(tmp_path / "copy")


def test_tables_whose_definition_is_damaged_are_rebuilt(tmp_path: Path) -> None:
    """SQLite's message about the definition is then no UTF-8, which Python reports by an error of its own."""
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        store.save(Capture("a", "OD", CLOCK.wall(), True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})
    database = tmp_path / schema.DATABASE
    definition = b"CREATE TABLE idempotency_keys"
    assert definition in database.read_bytes()
    database.write_bytes(database.read_bytes().replace(definition, definition.replace(b"TABLE", b"TABL\xf3")))
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert store.recovery.rebuilt_because is not None
        assert [capture.id for capture in store.captures()] == ["a"]
