"""Capture journal: interrupted captures after a power cut."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        yield store


def test_a_stored_capture_is_not_interrupted_and_a_damaged_entry_still_gives_its_eye(store: CaptureStore) -> None:
    folder = store.folder / "underway"
    CaptureJournal(store).begin(InterruptedCapture("20260301T120000-OS-ab", "OS", "v", "L-nerve", 1))
    (folder / "20260301T120001-OD-cd.json").write_bytes(b"{half")
    kept = Capture("20260301T120002-OD-ef", "OD", datetime(2026, 3, 1, tzinfo=UTC), True, "00ff", CaptureReport(), {})
    CaptureJournal(store).begin(InterruptedCapture(kept.id, "OD"))
    store.save(kept, {"raw.tiff": b"1"})
    found = CaptureJournal(store)
    assert found.interrupted == (
        InterruptedCapture("20260301T120000-OS-ab", "OS", "v", "L-nerve", 1),
        InterruptedCapture("20260301T120001-OD-cd", "OD"),
    )
    assert not (folder / f"{kept.id}.json").exists()
    found.discard(lambda one: one.eye == "OS")
    assert [one.eye for one in CaptureJournal(store).interrupted] == ["OD"]


def test_a_test_picture_is_reported_in_one_run_and_a_picture_of_a_visit_until_it_is_repeated(
    store: CaptureStore,
) -> None:
    test_picture = InterruptedCapture("20260301T120000-OD-ab", "OD")
    of_visit = InterruptedCapture("20260301T120001-OS-cd", "OS", "v", "L-nerve", 0)
    before = CaptureJournal(store)
    before.begin(test_picture)
    before.begin(of_visit)
    assert CaptureJournal(store).interrupted == (test_picture, of_visit)
    reported = CaptureJournal(store)
    assert reported.interrupted == (test_picture, of_visit), "an opening alone reports nothing"
    reported.mark_reported()
    assert reported.interrupted == (test_picture, of_visit)
    assert CaptureJournal(store).interrupted == (of_visit,)
