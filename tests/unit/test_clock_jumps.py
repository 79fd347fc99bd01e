"""Jumps of the date by a year: no order of a list and no dose changes."""

from collections.abc import Iterator
from datetime import timedelta
from itertools import count
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import LightLimit
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.upload_queue import UploadQueue
from services.records.visit_repository import VisitRepository

YEAR = timedelta(days=366)
JUMPS = [(-YEAR, YEAR), (YEAR, -YEAR), (-YEAR, -YEAR), (YEAR, YEAR)]
FILES = {"raw.tiff": b"raw"}
DAY_S = 86_400.0


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def store(tmp_path: Path, clock: VirtualClock) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0, clock=clock) as opened:
        yield opened


@pytest.mark.parametrize("jumps", JUMPS)
def test_lists_are_in_the_order_of_storage(
    store: CaptureStore, clock: VirtualClock, jumps: tuple[timedelta, ...]
) -> None:
    keys, people = (f"{number:016x}" for number in count()), VisitRepository(store.engine, load_programme(), clock)
    visits, captures = list[str](), list[str]()
    for number, jump in enumerate((timedelta(), *jumps)):
        clock.start += jump
        visits.append(people.begin(next(keys)).id)
        captures.append(f"c{number}")
        store.save(Capture(captures[-1], "OD", clock.wall(), True, "00ff", CaptureReport(), {}), FILES)
        people.finish(next(keys), visits[-1])
    assert [visit.id for visit in people.visits(2)] == visits[:0:-1], "the newest two"
    assert [capture.id for capture in store.captures(2)] == captures[:0:-1]
    assert {entry.visit for entry in UploadQueue(store.engine, clock).queued()} == set(visits)
    store.close()
    with CaptureStore(store.folder, reserve_bytes=0, clock=clock) as again:
        assert [capture.id for capture in again.captures()] == captures[::-1]


@pytest.mark.parametrize("jumps", JUMPS)
def test_no_dose_expires_by_the_date(store: CaptureStore, clock: VirtualClock, jumps: tuple[timedelta, ...]) -> None:
    ledger = DoseLedgerStore(store.engine, clock, DAY_S, boot="boot")
    ledger.settle(ledger.reserve(("OD",), 0.9, 1.0), 0.9)
    for jump in jumps:
        clock.start += jump
        assert ledger.spent_j_per_cm2("OD") == 0.9
        again = DoseLedgerStore(store.engine, clock, DAY_S, boot="another boot")
        assert again.spent_j_per_cm2("OD") == 0.9
        with pytest.raises(LightLimit):
            again.reserve(("OD",), 0.2, 1.0)
