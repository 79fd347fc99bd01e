"""Rows leave the log for the main file when nobody presses, and the second copy of the dose ledger counts."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.values import Capture
from services.instrument.checkpointing import IDLE_S, Checkpoints
from services.records.light_book import LightBook
from services.records.store import Store

DAY_S = 86_400.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "data", reserve_bytes=0) as store:
        yield store


def keep(store: Store, id: str) -> None:
    store.keep(Capture(id, "OD", VirtualClock().wall(), True, "00ff", {}, {}), {"raw.tiff": b"raw"})


def in_main_file(store: Store, to: Path) -> list[str]:
    """The captures of the main file alone, as a copy without the log has them."""
    to.write_bytes((store.folder / "shelf.sqlite").read_bytes())
    with closing(sqlite3.connect(f"file:{to}?mode=ro&immutable=1", uri=True)) as tables:
        return [id for (id,) in tables.execute("SELECT id FROM captures ORDER BY id")]


def test_a_clean_close_and_an_opening_after_a_kill_leave_nothing_in_the_log(store: Store, tmp_path: Path) -> None:
    keep(store, "a")
    assert in_main_file(store, tmp_path / "copy") == []
    with Store(store.folder, reserve_bytes=0):  # what was left by the first, which might have been killed here
        assert store.log_bytes() == 0
        assert in_main_file(store, tmp_path / "copy") == ["a"]
    keep(store, "b")
    store.close()
    assert in_main_file(store, tmp_path / "copy") == ["a", "b"]
    assert not (store.folder / "shelf.sqlite-wal").exists()


def test_the_log_is_emptied_after_a_rest_or_soon_after_a_finish_and_never_during_a_press(
    store: Store, tmp_path: Path
) -> None:
    clock, now = VirtualClock(), {"idle": True, "none": True}
    checkpoints = Checkpoints(store, lambda: now["idle"], lambda: now["none"], clock)
    keep(store, "a")
    assert not checkpoints.step()
    clock.sleep(IDLE_S - 1)
    assert not checkpoints.step()
    clock.sleep(1)
    assert checkpoints.step()
    assert in_main_file(store, tmp_path / "copy") == ["a"]
    assert not checkpoints.step(), "nothing is in the log"
    keep(store, "b")
    now.update(idle=False, none=False)
    clock.sleep(10 * IDLE_S)
    checkpoints.soon()
    assert not checkpoints.step(), "a picture is being taken"
    now.update(none=True)
    assert checkpoints.step(), "somebody aims, and a visit was finished"
    keep(store, "c")
    assert not checkpoints.step()
    assert in_main_file(store, tmp_path / "copy") == ["a", "b"]


def test_while_another_reads_the_log_stays_and_nothing_fails(store: Store) -> None:
    keep(store, "a")
    with closing(sqlite3.connect(store.folder / "shelf.sqlite", isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT id FROM captures").fetchall()
        keep(store, "b")
        assert store.checkpoint() is False
        reader.execute("COMMIT")
    assert store.checkpoint() is True


def book(store: Store, clock: VirtualClock) -> LightBook:
    return LightBook(store.engine, clock, DAY_S, boot="boot")


def test_rows_that_are_gone_lower_no_dose(store: Store) -> None:
    clock = VirtualClock()
    first = book(store, clock)
    first.settle(first.reserve(("OD",), 1.0, 10.0), 0.25)
    clock.sleep(3600)
    first.reserve(("OS",), 2.0, 10.0)
    with closing(sqlite3.connect(store.folder / "shelf.sqlite", isolation_level=None)) as tables:
        tables.execute("DELETE FROM light_doses")
        tables.execute("DELETE FROM light_time")
    again = book(store, clock)
    assert (again.spent_j_per_cm2("OD"), again.spent_j_per_cm2("OS")) == (0.25, 2.0)
    clock.sleep(DAY_S)
    assert again.spent_j_per_cm2("OD") == 0.0, "it ages as before"


@pytest.mark.parametrize("block", [0, 1])
def test_of_two_blocks_of_the_copy_one_may_be_damaged(store: Store, block: int) -> None:
    clock = VirtualClock()
    first = book(store, clock)
    for _ in range(2):
        first.reserve(("OD",), 1.0, 10.0)
    first.settle(first.reserve(("OD",), 0.0, 10.0), 0.0)
    path = store.folder / "light.copy"
    content = bytearray(path.read_bytes())
    content[block * len(content) // 2 + 20] ^= 1
    path.write_bytes(content)
    with closing(sqlite3.connect(store.folder / "shelf.sqlite", isolation_level=None)) as tables:
        tables.execute("DELETE FROM light_doses")
    assert book(store, clock).spent_j_per_cm2("OD") == 2.0
    path.write_bytes(b"")
    assert book(store, clock).spent_j_per_cm2("OD") == 2.0, "the database has it again"
