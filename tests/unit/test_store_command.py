"""Command `diffuscope store`: check names what is damaged and changes nothing; rebuild restores from the files."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from device.clock import SystemClock
from device.errors import StoreError
from services.backup.store_command import app
from services.errors import RecordNotFound, StoreDamaged
from services.identity.audit_key import read_audit_key
from services.records.audit_log import AuditLog
from services.records.capture_store import CaptureStore
from tests.store_damage import Shown, expected, filled_store, shown

CHECKED = (
    "database",
    "copy of the dose ledger",
    "patients",
    "visits",
    "captures",
    "keys of patients",
    "files of captures",
)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Shown]:
    store = filled_store(tmp_path_factory.mktemp("filled"), with_log=False)
    return store, expected(store)


def check(folder: Path) -> tuple[int, dict[str, Any]]:
    done = CliRunner().invoke(app, ["check", "--json", "--data", str(folder)])
    return done.exit_code, {result["name"]: result for result in json.loads(done.stdout)}


def content(folder: Path) -> dict[str, bytes]:
    names = ("-wal", "-shm", ".lock")
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.suffix not in names}


def test_a_whole_store_is_whole_and_stays_as_it_is(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "store")
    before = content(folder)
    status, found = check(folder)
    assert (status, tuple(found)) == (0, CHECKED)
    assert found["visits"]["whole"] == len(filled[1].visits)
    assert found["files of captures"]["whole"] == len(filled[1].files)
    assert content(folder) == before
    assert "visits" in CliRunner().invoke(app, ["check", "--data", str(folder)]).stdout


@pytest.mark.parametrize(
    ("path", "kind"),
    [("visits/*.json", "visits"), ("patients/*.json", "patients"), ("captures/*/record.json", "captures")],
)
def test_a_damaged_record_is_healable_and_the_next_start_heals_it(
    filled: tuple[Path, Shown], tmp_path: Path, path: str, kind: str
) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "store")
    next(iter(sorted(folder.glob(path)))).write_bytes(b"{}")
    status, found = check(folder)
    assert (status, len(found[kind]["healable"]), found[kind]["damaged"]) == (1, 1, [])
    if kind != "captures":  # the record of a capture is written again when its rows change
        CaptureStore(folder, reserve_bytes=0).close()
        assert check(folder)[0] == 0


def test_a_changed_file_of_a_capture_is_damaged(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "store")
    (folder / "captures" / "test" / "raw.tiff").write_bytes(b"changed")
    status, found = check(folder)
    assert (status, found["files of captures"]["damaged"]) == (1, ["test/raw.tiff"])


def test_a_copy_of_a_capture_is_readable_without_the_store(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    data = shutil.copytree(filled[0], tmp_path / "store")
    words = ["copy", "test", "--data", str(data), "--output", str(tmp_path / "out")]
    assert CliRunner().invoke(app, words).exit_code == 0
    (entry,) = AuditLog(data, read_audit_key(data), SystemClock()).entries(9)
    assert (entry.action, entry.record, entry.more) == ("copy", "test", {"field": "plain", "by": "command"})
    copied = {("test", path.name): path.read_bytes() for path in (tmp_path / "out" / "test").iterdir()}
    assert copied == {place: content for place, content in filled[1].files.items() if place[0] == "test"}
    assert isinstance(CliRunner().invoke(app, words).exception, StoreError), "a copy was replaced"


def test_a_missing_database_is_healable_and_rebuild_restores_it(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "store")
    (folder / "store.sqlite").write_bytes(b"no database")
    status, found = check(folder)
    assert (status, len(found["database"]["healable"]), len(found["visits"]["healable"])) == (
        1,
        1,
        len(filled[1].visits),
    )
    done = CliRunner().invoke(app, ["rebuild", "--yes", "--data", str(folder)])
    assert (done.exit_code, (folder / "damaged" / "1" / "store.sqlite").read_bytes()) == (0, b"no database")
    assert f"{len(filled[1].visits)} visits and {len(filled[1].captures)} captures" in done.stdout
    assert shown(folder) == (filled[1], 0)


def test_a_running_instrument_and_an_empty_folder_are_refused(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "store")
    with CaptureStore(folder, reserve_bytes=0) as store:
        store.captures()
        refused = CliRunner().invoke(app, ["rebuild", "--yes", "--data", str(folder)]).exception
    assert isinstance(refused, StoreError)
    for command, kind in (("check", RecordNotFound), ("rebuild", StoreDamaged)):
        empty = CliRunner().invoke(app, [command, "--data", str(tmp_path / "none")], input="y\n").exception
        assert isinstance(empty, kind)
