"""Adoption: rows of captures that were lost or damaged are rebuilt from the records in the capture folders."""

import json
import random
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import SettingError
from services.records.capture import Capture, CaptureReport, PictureVerdict
from services.records.capture_record import RECORD
from services.records.capture_store import CaptureStore
from services.records.protocol import load_protocol
from services.records.quarantine import REQUIRED_FILES
from services.records.visit_repository import VisitRepository

FILES = {name: name.encode() * 50 for name in REQUIRED_FILES}
KEYS = (f"{number:016x}" for number in range(1 << 16))
FLIPS = 20


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        yield opened


def saved(store: CaptureStore, id: str) -> Capture:
    made = CaptureReport(verdict=PictureVerdict("good", numbers={"level": 0.25}), budget_s=2.5)
    return store.save(Capture(id, "OD", VirtualClock().wall(), True, "00ff", made, {}), FILES)


def without_rows(folder: Path, *statements: str) -> None:
    with sqlite3.connect(folder / "shelf.sqlite", isolation_level=None) as database:
        for statement in statements:
            database.execute(statement)
    database.close()


LOST_ROWS = ("DELETE FROM shots", "DELETE FROM files", "DELETE FROM captures")


def test_captures_without_rows_are_adopted_with_all_that_was_stored(store: CaptureStore) -> None:
    kept = [saved(store, id) for id in ("b", "a")]
    store.close()
    without_rows(store.folder, *LOST_ROWS)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.adopted, again.newly_quarantined) == (("a", "b"), ())
        assert sorted(again.captures(), key=lambda one: one.id) == sorted(kept, key=lambda one: one.id)
        assert {name: again.read("a", name) for name in FILES} == FILES
        assert again.quarantine.orphans() == []
    with CaptureStore(store.folder, reserve_bytes=0) as once_more:
        assert once_more.adopted == ()


def test_an_adopted_capture_is_in_the_slot_of_its_visit(store: CaptureStore) -> None:
    people = VisitRepository(store.engine, load_protocol(), VirtualClock())
    visit = people.answer(next(KEYS), people.begin(next(KEYS)).id, "consent", "agreed").id
    target = people.pictures.capture_target("OD", None, visit, "R-centre")
    report = CaptureReport(visit=visit, slot="R-centre", verdict=PictureVerdict("good"))
    store.save(Capture("a", "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    moved = people.pictures.correct_laterality(next(KEYS), "a", "OS", None)
    stored = store.get("a")
    assert stored.eye == "OS"
    store.close()
    without_rows(store.folder, "DELETE FROM slots", *LOST_ROWS)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.get("a") == stored, "the record holds the correction of the eye"
        slots = VisitRepository(again.engine, load_protocol(), VirtualClock()).get(visit).slots
        assert [one.capture for one in slots["L-centre"].captures] == ["a"]
        assert slots["L-centre"].captures == moved.slots["L-centre"].captures


def test_an_unreadable_row_is_healed_and_its_neighbours_are_unchanged(store: CaptureStore) -> None:
    kept = [saved(store, id) for id in ("a", "b", "c")]
    store.close()
    without_rows(
        store.folder,
        "PRAGMA ignore_check_constraints = ON",
        "UPDATE captures SET report = replace(report, ':', ';') WHERE id = 'b'",
    )
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.healed, again.damaged()) == (("b",), 0)
        assert again.captures() == kept[::-1]


@pytest.mark.parametrize("name", [RECORD, "raw.tiff"])
def test_a_flipped_bit_in_a_folder_without_a_row_is_never_adopted(store: CaptureStore, name: str) -> None:
    """Either the record still describes the capture as it was stored, or the folder stays as it is, without a row."""
    kept = saved(store, "a")
    store.close()
    random_source = random.Random(20)
    adopted = 0
    for turn in range(FLIPS):
        folder = shutil.copytree(store.folder, store.folder.with_name(f"{turn}"))
        without_rows(folder, *LOST_ROWS)
        place = folder / "captures" / "a" / name
        content = bytearray(place.read_bytes())
        content[random_source.randrange(len(content))] ^= 1 << random_source.randrange(8)
        place.write_bytes(content)
        with CaptureStore(folder, reserve_bytes=0) as again:
            assert again.captures() in ([], [kept]), turn
            adopted += len(again.adopted)
            assert len(again.adopted) + len(again.quarantine.orphans()) == 1, turn
    assert adopted == 0 or name == RECORD, "a changed file was adopted"
    assert adopted < FLIPS, "no flip was found, so the test shows nothing"


def test_a_database_that_takes_no_rows_does_not_prevent_the_start(store: CaptureStore) -> None:
    kept = saved(store, "a")
    store.close()
    refuse = "CREATE TRIGGER full BEFORE INSERT ON captures BEGIN SELECT RAISE(FAIL, 'no space'); END"
    without_rows(store.folder, *LOST_ROWS, refuse)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.adopted, again.quarantine.orphans()) == ((), ["a"])
    without_rows(store.folder, "DROP TRIGGER full")
    with CaptureStore(store.folder, reserve_bytes=0) as once_more:
        assert (once_more.adopted, once_more.captures()) == (("a",), [kept])


def test_a_record_of_another_capture_or_format_is_refused(store: CaptureStore) -> None:
    saved(store, "a")
    store.close()
    without_rows(store.folder, *LOST_ROWS)
    captures = store.folder / "captures"
    shutil.copytree(captures / "a", captures / "b")
    record = json.loads((captures / "a" / RECORD).read_bytes())
    (captures / "a" / RECORD).write_text(json.dumps(record | {"format": 2}))
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.adopted, again.quarantine.orphans()) == ((), ["a", "b"])


def test_a_file_cannot_take_the_place_of_the_record(store: CaptureStore) -> None:
    with pytest.raises(SettingError, match="written by the store"):
        store.save(Capture("a", "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {}), {RECORD: b"{}"})
