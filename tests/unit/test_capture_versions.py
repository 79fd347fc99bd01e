"""Later versions of pictures in the store: adoption, repetition, refusals, recovery, removal, backup."""

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device.clock import VirtualClock
from device.errors import StoreError
from services.backup import store_contents
from services.errors import RecordNotFound, VersionRefused
from services.records.capture import CaptureReport, RecordOrigin
from services.records.capture_store import CaptureStore
from services.records.capture_versions import NewVersion
from services.records.recovery import rebuild_database
from services.records.removed_captures import Removal
from services.records.schema import report_text
from services.records.store_check import check_store
from tests.stored_captures import write_store

RAW = np.full((6, 8), 100, np.uint16)
ID = "20260301T120000-OD-aa"
NOON: datetime = VirtualClock().wall()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    write_store(tmp_path, RAW, "0123456789abcdef", (ID,), RecordOrigin(uuid="here"))
    with CaptureStore(tmp_path, reserve_bytes=0) as opened:
        yield opened


def version(store: CaptureStore, result: str = "a" * 32, **changed: Any) -> NewVersion:
    """Return a new picture of the stored frames."""
    frames = {name: digest for name, digest in store.get(ID).files.items() if name.endswith(".tiff")}
    new = NewVersion(ID, result, frames, "here", "variation", "1.2", b"new picture", b'{"method": "variation"}')
    return replace(new, **changed)


def test_a_version_stands_beside_the_picture_as_taken(store: CaptureStore) -> None:
    taken = store.get(ID)
    first = store.versions.adopt(version(store), NOON)
    second = store.versions.adopt(version(store, "b" * 32, colour=b"in colour"), NOON)
    assert (first.number, second.number) == (1, 2)
    kept = store.get(ID)
    assert kept.report.versions == (first, second)
    assert kept.files.items() >= taken.files.items()
    assert set(kept.files) - set(taken.files) == {
        "picture-1.png",
        "report-1.json",
        "picture-2.png",
        "colour-2.png",
        "report-2.json",
    }
    assert store.read(ID, first.picture) == b"new picture"
    assert store.read(ID, second.colour) == b"in colour"
    assert store.read(ID, "report.json") == b"{}"
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.get(ID) == kept
    assert all(result.is_whole for result in check_store(store.folder, lambda _: None) if "ledger" not in result.name)


def test_a_result_is_adopted_once(store: CaptureStore) -> None:
    first = store.versions.adopt(version(store), NOON)
    assert store.versions.adopt(version(store, picture=b"other bytes"), NOON) == first
    assert store.read(ID, first.picture) == b"new picture"
    assert len(store.get(ID).report.versions) == 1


def test_files_that_a_power_cut_left_without_rows_are_replaced(store: CaptureStore) -> None:
    (store.folder / "captures" / ID / "picture-1.png").write_bytes(b"half")
    assert store.versions.adopt(version(store), NOON).number == 1
    assert store.read(ID, "picture-1.png") == b"new picture"


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"capture": "20260301T120000-OD-bb"}, RecordNotFound, "no capture named"),
        ({"capture": "../x"}, RecordNotFound, "no capture named"),
        ({"device": "elsewhere"}, VersionRefused, "by the device here"),
        ({"frames": {"raw.tiff": "0" * 64}}, VersionRefused, "other frames.*: dark.tiff, raw.tiff"),
    ],
)
def test_a_picture_of_something_else_is_refused(
    store: CaptureStore, changed: dict[str, object], error: type[StoreError], message: str
) -> None:
    before = store.get(ID), sorted((store.folder / "captures" / ID).iterdir())
    with pytest.raises(error, match=message) as caught:
        store.versions.adopt(version(store, **changed), NOON)
    assert caught.value.remedy
    assert (store.get(ID), sorted((store.folder / "captures" / ID).iterdir())) == before


def test_versions_are_in_the_record_from_which_the_database_is_rebuilt(store: CaptureStore) -> None:
    store.versions.adopt(version(store), NOON)
    kept = store.get(ID)
    store.close()
    rebuild_database(store.folder)
    with CaptureStore(store.folder, reserve_bytes=0) as rebuilt:
        assert rebuilt.get(ID) == kept


def test_pictures_of_versions_are_removed_with_the_large_files_and_come_back(store: CaptureStore) -> None:
    store.versions.adopt(version(store, colour=b"in colour"), NOON)
    store.removed.remove([ID], Removal("sent", NOON))
    left = {path.name for path in (store.folder / "captures" / ID).iterdir()}
    assert left == {"report.json", "report-1.json", "record.json", "removed.json"}
    store.removed.undo()
    assert store.read(ID, "colour-1.png") == b"in colour"


def test_a_backup_holds_the_versions_and_notices_a_new_one(store: CaptureStore) -> None:
    (unit,) = [name for name in store_contents.units(store.folder) if name.startswith("captures")]
    before = store_contents.fingerprint(store.folder, unit)
    store.versions.adopt(version(store), NOON)
    assert store_contents.fingerprint(store.folder, unit) != before
    names = {path.name for path, _ in store_contents.unpacked(store_contents.packed_unit(store.folder, unit))}
    assert {"picture-1.png", "report-1.json", "picture.png"} <= names


def test_a_version_of_a_later_release_is_read_and_written_unchanged() -> None:
    stored = '{"versions": [{"number": 1, "result": "r", "at": null, "method": 3, "software": "9", "new": [1]}]}'
    report = CaptureReport.parse(stored)
    (entry,) = report.versions
    assert (entry.number, entry.result, entry.method) == (1, "r", None)
    assert CaptureReport.parse(report_text(report)) == report
    assert '"method": 3' in report_text(report)
    assert CaptureReport.parse('{"versions": 3}').versions == ()


def test_a_copy_on_a_disk_that_takes_no_changes_refuses_them(store: CaptureStore, tmp_path: Path) -> None:
    store.close()
    copy = tmp_path.with_name("copy")
    shutil.copytree(tmp_path, copy)
    refusal = StoreError("the disk is read-only")
    with CaptureStore(copy, reserve_bytes=0, refusal=refusal) as other:
        digest = hashlib.sha256((copy / "captures" / ID / "record.json").read_bytes()).digest()
        with pytest.raises(StoreError, match="read-only"):
            other.versions.adopt(version(other), NOON)
        assert hashlib.sha256((copy / "captures" / ID / "record.json").read_bytes()).digest() == digest
