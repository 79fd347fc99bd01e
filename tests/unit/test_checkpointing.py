"""Checkpoints of the write-ahead log (WAL) in idle time, and the redundant copy of the dose ledger."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services.instrument.checkpointing import IDLE_S, Checkpoints
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore

DAY_S = 86_400.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "data", reserve_bytes=0) as store:
        yield store


def keep(store: CaptureStore, id: str) -> None:
    store.save(Capture(id, "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})


def in_main_file(store: CaptureStore, to: Path) -> list[str]:
    """Return the capture ids in a copy of the main database file without its WAL."""
    to.write_bytes((store.folder / "store.sqlite").read_bytes())
    with closing(sqlite3.connect(f"file:{to}?mode=ro&immutable=1", uri=True)) as tables:
        return [id for (id,) in tables.execute("SELECT id FROM captures ORDER BY id")]


def test_close_and_reopening_after_a_kill_leave_an_empty_wal(store: CaptureStore, tmp_path: Path) -> None:
    keep(store, "a")
    assert in_main_file(store, tmp_path / "copy") == []
    with CaptureStore(
        store.folder, reserve_bytes=0
    ):  # opens the files left by a process that might have been killed here
        assert store.write_ahead_log.length_bytes() == 0
        assert in_main_file(store, tmp_path / "copy") == ["a"]
    keep(store, "b")
    store.close()
    assert in_main_file(store, tmp_path / "copy") == ["a", "b"]
    assert not (store.folder / "store.sqlite-wal").exists()


def test_the_wal_is_checkpointed_when_idle_or_on_request_and_never_during_a_press(
    store: CaptureStore, tmp_path: Path
) -> None:
    clock, conditions = VirtualClock(), {"idle": True, "none": True}
    checkpoints = Checkpoints(store, lambda: conditions["idle"], lambda: conditions["none"], clock)
    keep(store, "a")
    assert not checkpoints.step()
    clock.sleep(IDLE_S - 1)
    assert not checkpoints.step()
    clock.sleep(1)
    assert checkpoints.step()
    assert in_main_file(store, tmp_path / "copy") == ["a"]
    assert not checkpoints.step(), "the WAL is empty"
    keep(store, "b")
    conditions.update(idle=False, none=False)
    clock.sleep(10 * IDLE_S)
    checkpoints.request()
    assert not checkpoints.step(), "a capture is in progress"
    conditions.update(none=True)
    assert checkpoints.step(), "live pictures are requested and a visit was finished"
    keep(store, "c")
    assert not checkpoints.step()
    assert in_main_file(store, tmp_path / "copy") == ["a", "b"]


def test_a_checkpoint_during_a_read_transaction_is_deferred_without_error(store: CaptureStore) -> None:
    keep(store, "a")
    with closing(sqlite3.connect(store.folder / "store.sqlite", isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT id FROM captures").fetchall()
        keep(store, "b")
        assert store.write_ahead_log.checkpoint() is False
        reader.execute("COMMIT")
    assert store.write_ahead_log.checkpoint() is True


def open_ledger(store: CaptureStore, clock: VirtualClock) -> DoseLedgerStore:
    return DoseLedgerStore(store.engine, clock, DAY_S, boot="boot")


def test_deleted_rows_lower_no_dose(store: CaptureStore) -> None:
    clock = VirtualClock()
    first = open_ledger(store, clock)
    first.settle(first.reserve(("OD",), 1.0, 10.0), 0.25)
    clock.sleep(3600)
    first.reserve(("OS",), 2.0, 10.0)
    with closing(sqlite3.connect(store.folder / "store.sqlite", isolation_level=None)) as tables:
        tables.execute("DELETE FROM doses")
        tables.execute("DELETE FROM observed_time")
    again = open_ledger(store, clock)
    assert (again.spent_j_per_cm2("OD"), again.spent_j_per_cm2("OS")) == (0.25, 2.0)
    clock.sleep(DAY_S)
    assert again.spent_j_per_cm2("OD") == 0.0, "the dose ages as before"
