"""Migrations: each only adds, so that earlier releases work on later tables; snapshots and their restoration."""

import ast
import json
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from fnmatch import fnmatch
from os.path import commonprefix
from pathlib import Path

import pytest
from alembic.script import ScriptDirectory
from typer.testing import CliRunner

from device.clock import SystemClock, VirtualClock
from device.errors import StoreError, StoreFull
from services.errors import RecordNotFound, StoreDamaged
from services.records import schema
from services.records.capture_report import read_verdict
from services.records.capture_store import CaptureStore
from services.records.command import app
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.protocol import load_protocol
from services.records.snapshots import KEPT_VERSIONS, Snapshots
from services.records.visit import SlotCapture
from services.records.visit_repository import VisitRepository
from tests.earlier import RAW, READS, WRITES, Release, store_of_version
from tests.golden.files import EARLIER
from tests.project_files import files, nodes, text

VERSIONS = sorted(script.revision for script in ScriptDirectory.from_config(schema.migration_config()).walk_revisions())
HEAD = VERSIONS[-1]
MIGRATIONS = [name for name in files() if fnmatch(name, "services/records/migrations/versions/r*.py")]
CHANGES = ("DROP ", "RENAME ", "DELETE ", "UPDATE ", "TRIGGER ")
# A trigger that only makes a digest null refuses nothing and changes no value that an older release reads or writes.
FORGETS_DIGEST = re.compile(
    r"CREATE TRIGGER \w+ AFTER [\w, ]+ ON \w+( WHEN (NEW|OLD)\.\w+ IS NOT NULL)?"
    r" BEGIN UPDATE \w+ SET record_sha256 = NULL WHERE \w+ = (NEW|OLD)\.\w+; END"
)
BINDS = ("CHECK", "UNIQUE", "REFERENCES", "PRIMARY KEY")


@pytest.mark.parametrize("version", WRITES)
def test_each_version_is_migrated_used_by_its_own_release_and_migrated_again(version: str, tmp_path: Path) -> None:
    earlier = Release(store_of_version(tmp_path, version), version)
    earlier.write(1)
    first = earlier.read(1)
    assert all(first[:3])
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert_complete(store, version, [1])
    assert earlier.read(1) == first
    earlier.write(2)  # rolled back: the earlier release reads and writes
    second = earlier.read(2)
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert_complete(store, version, [1, 2])
        assert store.newly_quarantined == ()
    assert (earlier.read(1), earlier.read(2)) == (first, second)
    assert version_of(tmp_path / "shelf.sqlite") == HEAD


def assert_complete(store: CaptureStore, version: str, numbers: list[int]) -> None:
    """Assert that this release reads all data of an earlier one."""
    assert {one.id for one in store.captures()} == {f"c{n}" for n in numbers}
    assert [store.read(f"c{n}", "raw.tiff") for n in numbers] == [RAW] * len(numbers)
    if version >= "r0002":
        ledger = DoseLedgerStore(store.engine, VirtualClock(elapsed_s=1.0), 86_400.0, boot="boot")
        assert ledger.spent_j_per_cm2("OD") == sum(numbers)
    if version >= "r0003":
        visits = VisitRepository(store.engine, load_protocol(), SystemClock()).visits(10)
        assert {(one.id, one.fields["age"]) for one in visits} == {(f"v{n}", 51) for n in numbers}


def test_every_version_of_the_tables_has_the_statements_of_its_release() -> None:
    assert list(WRITES) == list(READS) == VERSIONS


def version_of(path: Path) -> str:
    connection = sqlite3.connect(path)
    version = connection.execute("SELECT version_num FROM alembic_version").fetchone()[0]
    connection.close()
    return str(version)


# Permitted changes of a migration


def tables(folder: Path) -> dict[str, str]:
    connection = sqlite3.connect(folder / "shelf.sqlite")
    rows = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
    connection.close()
    return {name: " ".join(sql.split()) for name, sql in rows}


def contracted(before: dict[str, str], after: dict[str, str]) -> Iterator[str]:
    """Yield each change that breaks an older release: all but new tables, plain indexes and optional columns."""
    for name, sql in before.items():
        new = after.get(name, "")
        same = len(commonprefix([sql, new]))  # noqa: RUF071  # SQL, not paths
        added, rest = new[same : len(new) - len(sql) + same].upper(), sql[same:]
        if len(new) < len(sql) or not new.endswith(rest):
            yield f"{name} is gone, renamed or recreated"
            continue
        yield from (f"{name} is bound by {word}" for word in BINDS if word in added)
        if "NOT NULL" in added and "DEFAULT" not in added:
            yield f"{name} needs what an older release does not write"
    for name in after.keys() - before.keys():
        trigger = "TRIGGER" in after[name] and not FORGETS_DIGEST.fullmatch(after[name])
        if trigger or re.search(r"UNIQUE INDEX .* ON (\w+)", after[name]):
            yield f"{name} binds an older table"


def marked(name: str) -> bool:
    """Return whether a migration declares `takes_away = "..."`: what it removes, and the last release in need."""
    targets = [node.targets[0] for node in nodes(text(name)) if isinstance(node, ast.Assign)]
    return any(isinstance(target, ast.Name) and target.id == "takes_away" for target in targets)


def hand_made(name: str) -> list[str]:
    """Return SQL by hand that changes rows or names; docstrings are ignored."""
    upgrades = [node for node in nodes(text(name)) if isinstance(node, ast.FunctionDef) and node.name == "upgrade"]
    calls = [node for one in upgrades for node in ast.walk(one) if isinstance(node, ast.Call)]
    statements = [str(arg.value).upper() for call in calls for arg in call.args if isinstance(arg, ast.Constant)]
    return [word for word in CHANGES for line in statements if word in line]


@pytest.mark.parametrize("name", MIGRATIONS)
def test_a_migration_only_adds(name: str, tmp_path: Path) -> None:
    version = Path(name).name.split("_")[0]
    earlier = [one for one in VERSIONS if one < version]
    before = tables(store_of_version(tmp_path / "before", earlier[-1])) if earlier else {}
    after = tables(store_of_version(tmp_path / "after", version))
    assert marked(name) or not [*contracted(before, after), *hand_made(name)]


@pytest.mark.parametrize(
    ("change", "fine"),
    [
        ("ALTER TABLE files ADD COLUMN note TEXT", True),
        ("ALTER TABLE files ADD COLUMN note TEXT DEFAULT '' NOT NULL", True),
        ("CREATE TABLE notes (id TEXT PRIMARY KEY, capture TEXT REFERENCES captures(id)) STRICT", True),
        ("CREATE INDEX files_by_sum ON files (sha256)", True),
        ("ALTER TABLE files ADD COLUMN note TEXT CHECK (note != 'x')", False),
        ("ALTER TABLE files ADD COLUMN note TEXT REFERENCES captures(id)", False),
        ("ALTER TABLE files DROP COLUMN name2", False),
        ("ALTER TABLE files RENAME COLUMN sha256 TO sum", False),
        ("ALTER TABLE files RENAME TO file", False),
        ("DROP TABLE files", False),
        ("DROP INDEX captures_by_time", False),
        ("CREATE UNIQUE INDEX one_sum ON files (sha256)", False),
        ("CREATE TRIGGER deny BEFORE INSERT ON files BEGIN SELECT RAISE(ABORT, 'no'); END", False),
    ],
)
def test_a_change_that_breaks_an_older_release_is_detected(change: str, fine: bool, tmp_path: Path) -> None:
    folder = store_of_version(tmp_path, "r0001")
    connection = sqlite3.connect(folder / "shelf.sqlite")
    connection.execute("ALTER TABLE files ADD COLUMN name2 TEXT")
    before = tables(folder)
    connection.execute(change)
    connection.commit()
    connection.close()
    assert (list(contracted(before, tables(folder))) == []) == fine


# Snapshots


def test_a_snapshot_is_made_before_a_migration_and_never_without_one(tmp_path: Path) -> None:
    Release(store_of_version(tmp_path, "r0001"), "r0001").write(1)
    clock = VirtualClock(datetime(2026, 11, 21, tzinfo=UTC))
    for _ in range(2):
        with CaptureStore(tmp_path, clock=clock):
            assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["r0001-20261121T000000.db"]
        clock.sleep(1)
    snapshot = tmp_path / "snapshots" / "r0001-20261121T000000.db"
    assert version_of(snapshot) == "r0001"
    shutil.copy(snapshot, tmp_path / "shelf.sqlite")
    assert Release(tmp_path, "r0001").read(1)[1][0][0] == "c1"
    with CaptureStore(tmp_path / "new", clock=clock):
        assert not (tmp_path / "new" / "snapshots").exists()


def test_without_space_for_a_snapshot_no_migration_runs(tmp_path: Path) -> None:
    store_of_version(tmp_path, "r0002")
    with pytest.raises(StoreFull, match="before they are changed") as raised:
        CaptureStore(tmp_path, free_bytes=lambda folder: 9_000_000)
    assert "nothing was changed" in raised.value.remedy
    assert (version_of(tmp_path / "shelf.sqlite"), list((tmp_path / "snapshots").iterdir())) == ("r0002", [])


def test_the_last_snapshot_of_each_of_the_last_versions_is_kept(tmp_path: Path) -> None:
    store_of_version(tmp_path, "r0001")
    clock = VirtualClock(datetime(2035, 1, 1, tzinfo=UTC))
    snapshots = Snapshots(tmp_path / "shelf.sqlite", clock)
    for number in range(1, KEPT_VERSIONS + 3):
        snapshots.create(f"r{number:04}")
    clock.start = datetime(2020, 1, 1, tzinfo=UTC)  # a clock that was set back must not delete the newest
    snapshots.create(f"r{KEPT_VERSIONS + 2:04}")
    assert snapshots.names() == ["r0003-20350101T000000.db", "r0004-20350101T000000.db", "r0005-20200101T000000.db"]


def restore(folder: Path, name: str) -> str:
    done = CliRunner().invoke(app, ["restore", name, "--data", str(folder), "--yes"], catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


@pytest.mark.parametrize("harm", ["none", "damaged", "gone"])
def test_a_snapshot_is_restored(harm: str, tmp_path: Path) -> None:
    earlier = Release(store_of_version(tmp_path, "r0003"), "r0003")
    earlier.write(1)
    Snapshots(tmp_path / "shelf.sqlite", SystemClock()).create("r0003")
    earlier.write(2)
    if harm == "damaged":
        (tmp_path / "shelf.sqlite").write_bytes(b"not tables" * 1000)
    elif harm == "gone":
        (tmp_path / "shelf.sqlite").unlink()
    names = CliRunner().invoke(app, ["list", "--data", str(tmp_path)]).output.split()
    words = restore(tmp_path, names[0])
    assert "1 captures were kept since, from c2 on" in words
    aside = tmp_path / "snapshots" / "replaced-1"
    assert (aside / "shelf.sqlite").exists() == (harm != "gone")
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert ([one.id for one in store.captures()], store.newly_quarantined) == (["c1"], ("c2",))


def test_restoring_is_refused_for_a_running_instrument_and_for_a_damaged_snapshot(tmp_path: Path) -> None:
    with CaptureStore(tmp_path) as store:
        snapshots = Snapshots(tmp_path / "shelf.sqlite", SystemClock())
        snapshots.create(HEAD)
        assert store.captures() == []
        with pytest.raises(StoreError, match="is running"):
            snapshots.restore(snapshots.names()[0])
    with pytest.raises(RecordNotFound):
        snapshots.restore("../shelf.sqlite")
    name = snapshots.names()[0]
    path = snapshots.folder / name
    content = bytearray(path.read_bytes())
    content[4096:12288] = bytes(8192)
    path.write_bytes(content)
    with pytest.raises(StoreDamaged, match="damaged"):
        snapshots.restore(name)


# Columns of a capture that are computed from its report (r0005)


def columns(folder: Path) -> dict[str, tuple[object, ...]]:
    """Return visit, slot, verdict and laterality of each capture by id, as the tables have them."""
    with closing(sqlite3.connect(folder / "shelf.sqlite")) as connection:
        found = connection.execute("SELECT id, visit, slot, verdict, laterality FROM captures").fetchall()
    return {id: tuple(values) for id, *values in found}


def test_columns_of_stored_captures_hold_the_entries_of_their_reports(tmp_path: Path) -> None:
    Release(store_of_version(tmp_path, "r0004"), "r0004").write(1)
    shutil.copytree(EARLIER["r0004"], tmp_path / "kept")
    with CaptureStore(tmp_path, reserve_bytes=0), CaptureStore(tmp_path / "kept", reserve_bytes=0) as kept:
        assert columns(tmp_path) == {"c1": (None, None, '{"n":1}', None)}
        stored = {one.id: one.report for one in kept.captures()}
        assert {id: row[:2] for id, row in columns(kept.folder).items()} == {
            id: (report.visit, report.slot) for id, report in stored.items()
        }
        for id, (_, _, verdict, laterality) in columns(kept.folder).items():
            assert (read_verdict(json.loads(str(verdict))), laterality) == (stored[id].verdict, None)


def test_after_a_rollback_the_columns_follow_what_the_earlier_release_writes(tmp_path: Path) -> None:
    """A capture and a corrected eye that the earlier release writes have their columns without another migration."""
    earlier = Release(store_of_version(tmp_path, "r0004"), "r0004")
    earlier.write(1)
    with CaptureStore(tmp_path, reserve_bytes=0):
        pass
    earlier.write(2)
    report = {"visit": "v1", "slot": "R-nerve", "verdict": {"word": "good"}, "laterality": {"eye": "OS"}}
    with closing(sqlite3.connect(tmp_path / "shelf.sqlite", isolation_level=None)) as old:
        old.execute("UPDATE captures SET eye=?, report=? WHERE captures.id = ?", ("OD", json.dumps(report), "c1"))
        old.execute("UPDATE shots SET slot=? WHERE shots.capture = ?", ("R-nerve", "c1"))
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert columns(tmp_path) == {
            "c1": ("v1", "R-nerve", '{"word":"good"}', '{"eye":"OS"}'),
            "c2": (None, None, '{"n":2}', None),
        }
        slots = VisitRepository(store.engine, load_protocol(), SystemClock()).get("v1").slots
        assert [one.capture for one in slots["R-nerve"].captures] == ["c1"]
        assert slots["R-nerve"].captures[0].is_good


@pytest.mark.parametrize("report", ["{", "", "null", "[]", "3", '{"slot": 3, "verdict": "x", "laterality": [1]}'])
def test_a_report_without_usable_entries_has_empty_columns(report: str, tmp_path: Path) -> None:
    """An earlier release may have written it, or the disk may have damaged it; its capture keeps its slot."""
    Release(store_of_version(tmp_path, "r0004"), "r0004").write(1)
    with closing(sqlite3.connect(tmp_path / "shelf.sqlite", isolation_level=None)) as old:
        old.execute("PRAGMA ignore_check_constraints = ON")
        old.execute("UPDATE captures SET report = ?", (report,))
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert columns(tmp_path) == {"c1": (None, None, None, None)}
        slots = VisitRepository(store.engine, load_protocol(), SystemClock()).get("v1").slots
        assert slots["R-centre"].captures == (SlotCapture("c1", None),)
