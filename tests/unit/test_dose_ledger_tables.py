"""Tables of the dose ledger: expiry of doses, persistence, and no light without a writable ledger."""

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from device.clock import VirtualClock, boot_id
from device.errors import DailyLightLimit, LightLimit, StoreError
from device.light_safety.dose_ledger import INTERVAL_S, MemoryLedger
from device.light_safety.guard import LIT_AFTER_KILL_S, GuardedLight
from device.light_safety.hazard import Beam, Hazard, light_limits
from device.values import Illumination
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from tests.unit.test_guard import Lamp

DAY_S, STOP = 86400.0, 0.1
GREEN = Illumination("green")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:
        yield store


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def open_ledger(store: CaptureStore, clock: VirtualClock, boot: str = "first") -> DoseLedgerStore:
    return DoseLedgerStore(store.engine, clock, DAY_S, boot)


def guard(lamp: Lamp, clock: VirtualClock, ledger: DoseLedgerStore, w_per_cm2: float = 100e-6) -> GuardedLight:
    """Return a lamp of 100 uW/cm2 at a wavelength whose weight is 1."""
    return GuardedLight(lamp, clock, 10.0, Hazard({"green": Beam(0.440, w_per_cm2, 1e-6)}, light_limits()), ledger)


def test_a_reservation_counts_until_it_is_settled_with_the_given_dose(store: CaptureStore, clock: VirtualClock) -> None:
    ledger, lamp = open_ledger(store, clock), Lamp()
    guarded = guard(lamp, clock, ledger)
    with guarded.on(GREEN, ("OS",)):
        assert open_ledger(store, clock).spent_j_per_cm2("OS") == pytest.approx(100e-6 * (10 + LIT_AFTER_KILL_S))
        clock.sleep(2)
    assert ledger.spent_j_per_cm2("OS") == pytest.approx(200e-6)
    assert guarded.given_j_per_cm2 == pytest.approx(200e-6)
    assert ledger.spent_j_per_cm2("OD") == 0
    with guarded.on(GREEN):  # unknown eye
        clock.sleep(1)
    assert ledger.spent_j_per_cm2("OS") == pytest.approx(300e-6)
    assert ledger.spent_j_per_cm2("OD") == pytest.approx(100e-6)


def test_a_dose_with_an_unreadable_eye_counts_for_both_eyes(store: CaptureStore, clock: VirtualClock) -> None:
    """Also without the second copy of the ledger, which would restore the dose."""
    open_ledger(store, clock).reserve(("OD",), STOP / 2, STOP)
    with sqlite3.connect(store.folder / "store.sqlite") as tables:
        tables.execute("PRAGMA ignore_check_constraints = ON")  # as a flipped bit on the disk
        tables.execute("UPDATE doses SET eye = 'O?'")
    (store.folder / "dose-ledger.log").unlink()
    assert [open_ledger(store, clock).spent_j_per_cm2(eye) for eye in ("OD", "OS")] == [STOP / 2, STOP / 2]


def test_a_dose_expires_after_a_day_of_observed_time(store: CaptureStore, clock: VirtualClock) -> None:
    ledger = open_ledger(store, clock)
    ledger.settle(ledger.reserve(("OD",), STOP, STOP), STOP)
    clock.sleep(DAY_S)
    assert ledger.spent_j_per_cm2("OD") == STOP
    clock.sleep(2 * INTERVAL_S)
    assert ledger.spent_j_per_cm2("OD") == 0
    ledger.reserve(("OD",), STOP, STOP)


def test_neither_the_date_nor_the_time_without_power_expires_a_dose(store: CaptureStore, clock: VirtualClock) -> None:
    open_ledger(store, clock).reserve(("OD",), STOP, STOP)
    later = VirtualClock(clock.start + timedelta(days=400))
    for boot in ("second", "third"):  # each boot observes half a day
        ledger = open_ledger(store, later, boot)
        later.sleep(DAY_S / 2 + INTERVAL_S - 1)
        with pytest.raises(LightLimit):
            ledger.reserve(("OD",), STOP, STOP)
    later.sleep(2)
    ledger.reserve(("OD",), STOP, STOP)


def test_the_uptime_before_the_first_observation_expires_no_dose(store: CaptureStore, clock: VirtualClock) -> None:
    """The time before the first observation of this boot does not count, whatever the uptime."""
    open_ledger(store, clock).reserve(("OD",), STOP, STOP)
    ahead = VirtualClock(elapsed_s=10 * DAY_S)
    assert open_ledger(store, ahead, "second").spent_j_per_cm2("OD") == STOP


def test_a_new_process_of_the_same_boot_continues_the_observed_time(store: CaptureStore, clock: VirtualClock) -> None:
    open_ledger(store, clock).reserve(("OD",), STOP, STOP)
    clock.sleep(DAY_S + 2 * INTERVAL_S)
    assert open_ledger(store, clock).spent_j_per_cm2("OD") == 0


@pytest.mark.parametrize("durable", [True, False])
def test_a_refusal_gives_the_time_of_the_next_light(store: CaptureStore, durable: bool) -> None:
    clock = VirtualClock(datetime(2026, 1, 1, 8, 3, tzinfo=UTC))
    ledger = open_ledger(store, clock) if durable else MemoryLedger(clock)
    ledger.reserve(("OD",), STOP, STOP)
    clock.sleep(3600)
    then = (clock.start + timedelta(seconds=DAY_S + 2 * INTERVAL_S)).astimezone()
    with pytest.raises(LightLimit, match=rf"the right eye .* again after {then:%H:%M on %Y-%m-%d}") as raised:
        ledger.reserve(("OS", "OD"), 0.001, STOP)
    assert "stay on" in raised.value.remedy
    assert ledger.spent_j_per_cm2("OS") == 0  # refused for one eye, counted for neither
    clock.sleep(DAY_S + 2 * INTERVAL_S - 3600 - 1)
    with pytest.raises(LightLimit):
        ledger.reserve(("OD",), 0.001, STOP)
    clock.sleep(1)
    ledger.reserve(("OD",), 0.001, STOP)


def test_a_time_later_today_is_shown_without_its_date() -> None:
    clock = VirtualClock(datetime(2026, 1, 1, 0, 10).astimezone())
    ledger = MemoryLedger(clock, window_s=3600.0)
    ledger.reserve(("OS",), STOP, STOP)
    with pytest.raises(LightLimit, match=r"the left eye .* light is allowed again after 01:30"):
        ledger.reserve(("OS",), STOP, STOP)


def test_a_long_wait_is_the_daily_limit_and_a_short_one_a_rest() -> None:
    clock = VirtualClock()
    ledger = MemoryLedger(clock)
    ledger.reserve(("OD",), STOP, STOP)
    for passed_s, kind in ((0.0, DailyLightLimit), (22 * 3600.0, LightLimit)):
        clock.sleep(passed_s)
        with pytest.raises(LightLimit) as raised:
            ledger.reserve(("OD",), STOP, STOP)
        assert type(raised.value) is kind


def test_an_exposure_above_the_limit_itself_is_refused_as_such(store: CaptureStore, clock: VirtualClock) -> None:
    with pytest.raises(LightLimit, match="one exposure") as raised:
        open_ledger(store, clock).reserve(("OD",), 1.01 * STOP, STOP)
    assert "dimmer" in raised.value.remedy


def test_at_the_limit_the_lamp_stays_dark_for_that_eye_only(store: CaptureStore, clock: VirtualClock) -> None:
    lamp, ledger = Lamp(), open_ledger(store, clock)
    guarded = guard(lamp, clock, ledger, 109.5e-6)

    def expose() -> None:
        with guarded.on(GREEN, ("OD",), in_visit=True):
            clock.sleep(9.9)
        clock.sleep(10)

    for _ in range(145):  # 145 x 9.9 s x 109.5 uW/cm2
        expose()
    with pytest.raises(LightLimit, match="again after"):
        expose()
    assert lamp.illumination is None
    # at most one reservation below the limit
    assert 0 <= light_limits().stop_j_per_cm2 - ledger.spent_j_per_cm2("OD") < 109.5e-6 * (10 + LIT_AFTER_KILL_S)
    with guarded.on(GREEN, ("OS",)):
        assert lamp.illumination == GREEN
    assert guarded.dose_report().dose_high == ("OD",)


def test_no_light_without_a_writable_ledger(store: CaptureStore, clock: VirtualClock) -> None:
    lamp = Lamp()
    guarded = guard(lamp, clock, open_ledger(store, clock))
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute("CREATE TRIGGER full BEFORE INSERT ON doses BEGIN SELECT RAISE(FAIL, 'full'); END")
    with pytest.raises(StoreError, match="dose ledger cannot be written") as raised, guarded.on(GREEN):
        pytest.fail("light without a record")
    assert lamp.illumination is None
    assert "written down" in raised.value.remedy
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute("DROP TRIGGER full")
    connection.close()
    with guarded.on(GREEN):
        assert lamp.illumination == GREEN


def test_a_ledger_error_during_the_light_leaves_the_reservation_counted(
    store: CaptureStore, clock: VirtualClock
) -> None:
    lamp, ledger = Lamp(), open_ledger(store, clock)
    guarded = guard(lamp, clock, ledger)
    connection = sqlite3.connect(store.folder / "store.sqlite")
    with guarded.on(GREEN, ("OD",)):
        connection.execute("CREATE TRIGGER full BEFORE UPDATE ON doses BEGIN SELECT RAISE(FAIL, 'full'); END")
        connection.commit()
    assert lamp.illumination is None
    assert ledger.spent_j_per_cm2("OD") == pytest.approx(100e-6 * (10 + LIT_AFTER_KILL_S))
    connection.close()


KILLED = f"""
import sys, time
from pathlib import Path
from device.clock import SystemClock
from {DoseLedgerStore.__module__} import {DoseLedgerStore.__name__} as DoseLedger
from {CaptureStore.__module__} import {CaptureStore.__name__} as CaptureStore
store = CaptureStore(Path(sys.argv[1]), reserve_bytes=0)
DoseLedger(store.engine, SystemClock(), 86400.0).reserve(("OD",), 0.05, 0.1)
print("lit", flush=True)
time.sleep(60)
"""


def test_a_killed_process_has_spent_its_reservation(store: CaptureStore) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, store.folder], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "lit\n"
        os.kill(process.pid, signal.SIGKILL)
    assert open_ledger(store, VirtualClock(), boot_id()).spent_j_per_cm2("OD") == 0.05
