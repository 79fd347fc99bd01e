"""The book of light: what ages a dose, what does not, and that a book that cannot be written means no light."""

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.dose import Beam, Hazard, light_limits
from device.errors import LightDay, LightLimit, StoreError
from device.guard import AFTERGLOW_S, GuardedLight
from device.ledger import SLOT_S, MemoryLedger
from device.values import Glow
from services.records.light_book import LightBook, this_boot
from services.records.store import Store
from tests.unit.test_guard import Lamp

DAY_S, STOP = 86400.0, 0.1
GREEN = Glow("green")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "shelf", reserve_bytes=0) as store:
        yield store


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def book(store: Store, clock: VirtualClock, boot: str = "first") -> LightBook:
    return LightBook(store.engine, clock, DAY_S, boot)


def guard(lamp: Lamp, clock: VirtualClock, ledger: LightBook, w_per_cm2: float = 100e-6) -> GuardedLight:
    """A lamp of 100 uW/cm2 at a wavelength whose weight is 1."""
    return GuardedLight(lamp, clock, 10.0, Hazard({"green": Beam(0.440, w_per_cm2, 1e-6)}, light_limits()), ledger)


def test_what_was_reserved_is_counted_until_it_is_settled_and_then_what_was_given(
    store: Store, clock: VirtualClock
) -> None:
    ledger, lamp = book(store, clock), Lamp()
    guarded = guard(lamp, clock, ledger)
    with guarded.on(GREEN, ("OS",)):
        assert book(store, clock).spent_j_per_cm2("OS") == pytest.approx(100e-6 * (10 + AFTERGLOW_S))
        clock.sleep(2)
    assert ledger.spent_j_per_cm2("OS") == pytest.approx(200e-6)
    assert guarded.given_j_per_cm2 == pytest.approx(200e-6)
    assert ledger.spent_j_per_cm2("OD") == 0
    with guarded.on(GREEN):  # nobody knows which eye looks
        clock.sleep(1)
    assert ledger.spent_j_per_cm2("OS") == pytest.approx(300e-6)
    assert ledger.spent_j_per_cm2("OD") == pytest.approx(100e-6)


def test_a_dose_counts_for_a_day_of_seen_time_and_not_for_ever(store: Store, clock: VirtualClock) -> None:
    ledger = book(store, clock)
    ledger.settle(ledger.reserve(("OD",), STOP, STOP), STOP)
    clock.sleep(DAY_S)
    assert ledger.spent_j_per_cm2("OD") == STOP
    clock.sleep(2 * SLOT_S)
    assert ledger.spent_j_per_cm2("OD") == 0
    ledger.reserve(("OD",), STOP, STOP)


def test_neither_the_date_nor_the_time_that_it_was_off_forgives_anything(store: Store, clock: VirtualClock) -> None:
    book(store, clock).reserve(("OD",), STOP, STOP)
    later = VirtualClock(clock.start + timedelta(days=400))
    for boot in ("second", "third"):  # each of them sees half a day
        ledger = book(store, later, boot)
        later.sleep(DAY_S / 2 + SLOT_S - 1)
        with pytest.raises(LightLimit):
            ledger.reserve(("OD",), STOP, STOP)
    later.sleep(2)
    ledger.reserve(("OD",), STOP, STOP)


def test_a_boot_whose_clock_is_far_ahead_forgives_nothing(store: Store, clock: VirtualClock) -> None:
    """The time before this boot's first look was not seen, however long its computer has been on."""
    book(store, clock).reserve(("OD",), STOP, STOP)
    ahead = VirtualClock(elapsed_s=10 * DAY_S)
    assert book(store, ahead, "second").spent_j_per_cm2("OD") == STOP


def test_a_new_process_of_the_same_boot_goes_on_where_the_last_one_stopped(store: Store, clock: VirtualClock) -> None:
    book(store, clock).reserve(("OD",), STOP, STOP)
    clock.sleep(DAY_S + 2 * SLOT_S)
    assert book(store, clock).spent_j_per_cm2("OD") == 0


@pytest.mark.parametrize("durable", [True, False])
def test_a_refusal_says_when_there_is_light_again_and_there_is(store: Store, durable: bool) -> None:
    clock = VirtualClock(datetime(2026, 1, 1, 8, 3, tzinfo=UTC))
    ledger = book(store, clock) if durable else MemoryLedger(clock)
    ledger.reserve(("OD",), STOP, STOP)
    clock.sleep(3600)
    then = (clock.start + timedelta(seconds=DAY_S + 2 * SLOT_S)).astimezone()
    with pytest.raises(LightLimit, match=rf"the right eye .* again after {then:%H:%M on %Y-%m-%d}") as told:
        ledger.reserve(("OS", "OD"), 0.001, STOP)
    assert "stay on" in told.value.remedy
    assert ledger.spent_j_per_cm2("OS") == 0  # refused for one, counted for none
    clock.sleep(DAY_S + 2 * SLOT_S - 3600 - 1)
    with pytest.raises(LightLimit):
        ledger.reserve(("OD",), 0.001, STOP)
    clock.sleep(1)
    ledger.reserve(("OD",), 0.001, STOP)


def test_a_moment_later_today_is_told_by_its_hour_alone() -> None:
    clock = VirtualClock(datetime(2026, 1, 1, 0, 10).astimezone())
    ledger = MemoryLedger(clock, window_s=3600.0)
    ledger.reserve(("OS",), STOP, STOP)
    with pytest.raises(LightLimit, match=r"the left eye .* light is allowed again after 01:30$"):
        ledger.reserve(("OS",), STOP, STOP)


def test_a_wait_of_hours_is_the_limit_of_the_day_and_a_shorter_one_is_a_rest() -> None:
    clock = VirtualClock()
    ledger = MemoryLedger(clock)
    ledger.reserve(("OD",), STOP, STOP)
    for passed_s, kind in ((0.0, LightDay), (22 * 3600.0, LightLimit)):
        clock.sleep(passed_s)
        with pytest.raises(LightLimit) as told:
            ledger.reserve(("OD",), STOP, STOP)
        assert type(told.value) is kind


def test_an_exposure_that_is_too_much_for_any_day_is_told_as_such(store: Store, clock: VirtualClock) -> None:
    with pytest.raises(LightLimit, match="one exposure") as told:
        book(store, clock).reserve(("OD",), 1.01 * STOP, STOP)
    assert "dimmer" in told.value.remedy


def test_at_the_stop_the_lamp_stays_dark_and_the_other_eye_may_still_look(store: Store, clock: VirtualClock) -> None:
    lamp, ledger = Lamp(), book(store, clock)
    guarded = guard(lamp, clock, ledger, 219e-6)

    def expose() -> None:
        with guarded.on(GREEN, ("OD",)):
            clock.sleep(9.9)
        clock.sleep(10)

    for _ in range(72):  # 72 x 9.9 s x 219 uW/cm2
        expose()
    with pytest.raises(LightLimit, match="again after"):
        expose()
    assert lamp.glow is None
    # at the most one reservation short of the stop
    assert 0 <= light_limits().stop_j_per_cm2 - ledger.spent_j_per_cm2("OD") < 219e-6 * (10 + AFTERGLOW_S)
    with guarded.on(GREEN, ("OS",)):
        assert lamp.glow == GREEN
    assert guarded.account()["dose_high"] == ["OD"]


def test_without_a_book_there_is_no_light(store: Store, clock: VirtualClock) -> None:
    lamp = Lamp()
    guarded = guard(lamp, clock, book(store, clock))
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        connection.execute("CREATE TRIGGER full BEFORE INSERT ON light_doses BEGIN SELECT RAISE(FAIL, 'full'); END")
    with pytest.raises(StoreError, match="book of light") as told, guarded.on(GREEN):
        pytest.fail("it shone without a record")
    assert lamp.glow is None
    assert "written down" in told.value.remedy
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        connection.execute("DROP TRIGGER full")
    connection.close()
    with guarded.on(GREEN):
        assert lamp.glow == GREEN


def test_a_book_that_fails_while_it_is_lit_leaves_all_that_was_reserved_counted(
    store: Store, clock: VirtualClock
) -> None:
    lamp, ledger = Lamp(), book(store, clock)
    guarded = guard(lamp, clock, ledger)
    connection = sqlite3.connect(store.folder / "shelf.sqlite")
    with guarded.on(GREEN, ("OD",)):
        connection.execute("CREATE TRIGGER full BEFORE UPDATE ON light_doses BEGIN SELECT RAISE(FAIL, 'full'); END")
        connection.commit()
    assert lamp.glow is None
    assert ledger.spent_j_per_cm2("OD") == pytest.approx(100e-6 * (10 + AFTERGLOW_S))
    connection.close()


KILLED = """
import sys, time
from pathlib import Path
from device.clock import SystemClock
from services.records.light_book import LightBook
from services.records.store import Store
store = Store(Path(sys.argv[1]), reserve_bytes=0)
LightBook(store.engine, SystemClock(), 86400.0).reserve(("OD",), 0.05, 0.1)
print("lit", flush=True)
time.sleep(60)
"""


def test_a_process_that_is_killed_while_it_shines_has_spent_all_that_it_reserved(store: Store) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, store.folder], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "lit\n"
        os.kill(process.pid, signal.SIGKILL)
    assert book(store, VirtualClock(), this_boot()).spent_j_per_cm2("OD") == 0.05
