"""Capture journal: interrupted captures after a power cut."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.values import Frame, Illumination
from services.imaging.raw_metadata import RawMetadata
from services.instrument.frame_sink import FrameSink
from services.records import blobs
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import MAX_ATTEMPTS, CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
KEY = "0123456789abcdef"
LIT = ("green", "green")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        yield store


@pytest.fixture
def visit(store: CaptureStore) -> str:
    return VisitRepository(store.engine, load_programme(), VirtualClock()).begin(KEY).id


def test_a_stored_capture_is_not_interrupted_and_a_damaged_entry_still_gives_its_eye(
    store: CaptureStore, visit: str
) -> None:
    folder = store.folder / "journal"
    CaptureJournal(store).begin(InterruptedCapture("20260301T120000-OS-ab", "OS", visit, "L-nerve", 1))
    (folder / "20260301T120001-OD-cd.json").write_bytes(b"{half")
    kept = Capture("20260301T120002-OD-ef", "OD", datetime(2026, 3, 1, tzinfo=UTC), True, "00ff", CaptureReport(), {})
    CaptureJournal(store).begin(InterruptedCapture(kept.id, "OD"))
    store.save(kept, {"raw.tiff": b"1"})
    found = CaptureJournal(store)
    assert found.interrupted == (
        InterruptedCapture("20260301T120000-OS-ab", "OS", visit, "L-nerve", 1),
        InterruptedCapture("20260301T120001-OD-cd", "OD"),
    )
    assert not (folder / f"{kept.id}.json").exists()
    found.discard(lambda capture: capture.eye == "OS")
    assert [capture.eye for capture in CaptureJournal(store).interrupted] == ["OD"]


def test_a_test_picture_is_reported_in_one_run_and_a_picture_of_a_visit_until_it_is_repeated(
    store: CaptureStore, visit: str
) -> None:
    test_picture = InterruptedCapture("20260301T120000-OD-ab", "OD")
    of_visit = InterruptedCapture("20260301T120001-OS-cd", "OS", visit, "L-nerve", 0)
    before = CaptureJournal(store)
    before.begin(test_picture)
    before.begin(of_visit)
    assert CaptureJournal(store).interrupted == (test_picture, of_visit)
    reported = CaptureJournal(store)
    assert reported.interrupted == (test_picture, of_visit), "an opening alone reports nothing"
    reported.mark_reported()
    assert reported.interrupted == (test_picture, of_visit)
    assert CaptureJournal(store).interrupted == (of_visit,)


PRESS = InterruptedCapture("20260301T120000-OD-ab", "OD", None, None, 1)


def press_with_frames(store: CaptureStore, press: InterruptedCapture = PRESS, lights: tuple[str, ...] = LIT) -> None:
    """Journal a press as it is during its exposure, with one frame in each of these lights on the disk."""
    writer = CaptureJournal(store).begin(press, KEY, 3, ("red",))
    sink = FrameSink(writer, RawMetadata(press.id, "OD", NOON, calibration_id="00ff", head="head"), "green")
    for number, light in enumerate(lights):
        illumination = None if light == "dark" else Illumination("red" if light == "red" else "green")
        sink(Frame(np.full((8, 9), number, np.uint16), 0.1, number, illumination, True), 1e-5, 0.1)
    writer.finish()


def test_an_interrupted_press_with_a_lit_frame_is_resumable_with_its_key_and_plan(
    store: CaptureStore, visit: str
) -> None:
    press = replace(PRESS, visit=visit, slot="R-centre")
    press_with_frames(store, press)
    found = CaptureJournal(store)
    assert found.interrupted == ()
    (capture,) = found.resumable
    assert (capture.press, capture.key, capture.planned, capture.colours) == (press, KEY, 3, ("red",))
    assert [frame.file.path.name for frame in capture.frames] == ["raw.tiff", "raw-1.tiff"]
    found.end(PRESS.id)
    assert found.resumable == ()
    assert list((store.folder / "journal").iterdir()) == []


@pytest.mark.parametrize("lights", [(), ("dark",), ("red", "dark")])
def test_without_a_lit_frame_a_press_is_interrupted_and_its_frames_are_deleted(
    store: CaptureStore, lights: tuple[str, ...]
) -> None:
    press_with_frames(store, lights=lights)
    found = CaptureJournal(store)
    assert (found.interrupted, found.resumable) == ((PRESS,), ())
    assert [path.name for path in (store.folder / "journal").iterdir()] == [f"{PRESS.id}.json"]


def test_frames_of_a_stored_capture_and_frames_without_an_entry_are_deleted_at_the_opening(store: CaptureStore) -> None:
    press_with_frames(store)
    press_with_frames(store, InterruptedCapture("20260301T120000-OD-cd", "OD"))
    store.save(Capture(PRESS.id, "OD", NOON, True, "00ff", CaptureReport(), {}), {"raw.tiff": b"1"})
    (store.folder / "journal" / "20260301T120000-OD-cd.json").unlink()
    for _ in range(2):
        found = CaptureJournal(store)
        assert (found.interrupted, found.resumable) == ((), ())
        assert list((store.folder / "journal").iterdir()) == []


def test_a_failed_resumption_is_an_interrupted_capture_and_two_lost_attempts_end_it(store: CaptureStore) -> None:
    press_with_frames(store)
    failed = CaptureJournal(store)
    failed.fail(PRESS.id)
    assert (failed.interrupted, failed.resumable) == ((PRESS,), ())
    assert CaptureJournal(store).interrupted == (PRESS,)
    CaptureJournal(store).end(PRESS.id)
    press_with_frames(store)
    for _ in range(MAX_ATTEMPTS):
        journal = CaptureJournal(store)
        assert [capture.press for capture in journal.resumable] == [PRESS]
        journal.count_attempt(PRESS.id)  # and the process is killed
    assert (CaptureJournal(store).interrupted, CaptureJournal(store).resumable) == ((PRESS,), ())


@pytest.mark.parametrize("entry", [b"{half", b'{"id": "a", "eye": "OD", "visit": null, "slot": null, "tries": 0}'])
def test_frames_of_an_entry_that_does_not_name_its_target_are_not_resumed(store: CaptureStore, entry: bytes) -> None:
    press_with_frames(store)
    (store.folder / "journal" / f"{PRESS.id}.json").write_bytes(entry)
    found = CaptureJournal(store)
    assert found.resumable == ()
    assert [(capture.id, capture.eye, capture.visit) for capture in found.interrupted] == [(PRESS.id, "OD", None)]
    assert not (store.folder / "journal" / PRESS.id).exists()


def test_files_of_the_writer_are_linked_into_the_capture_and_outlast_the_journal(store: CaptureStore) -> None:
    press_with_frames(store)
    journal = CaptureJournal(store)
    (capture,) = journal.resumable
    files = {frame.file.path.name: frame.file for frame in capture.frames}
    before = {name: blobs.read_file(file.path, store.keys) for name, file in files.items()}
    inode = files["raw.tiff"].path.stat().st_ino
    kept = store.save(Capture(PRESS.id, "OD", NOON, True, "00ff", CaptureReport(), {}), {**files, "report.json": b"{}"})
    journal.end(PRESS.id)
    assert {name: store.read(kept.id, name) for name in before} == before
    assert (store.folder / "captures" / kept.id / "raw.tiff").stat().st_ino == inode, "it was written twice"
