"""Clocks, real and virtual, and deadlines on either."""

import math
import time
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.clock import Deadline, SystemClock, VirtualClock
from device.errors import SettingError


def test_virtual_sleep_takes_no_real_time() -> None:
    clock = VirtualClock()
    before, wall = time.monotonic(), clock.wall()
    clock.sleep(3600)
    assert clock.now_s() == 3600
    assert clock.wall() - wall == timedelta(hours=1)
    assert time.monotonic() - before < 60  # of the 3600 s


@pytest.mark.parametrize("clock", [SystemClock(), VirtualClock()])
def test_clocks_are_monotonic(clock: SystemClock | VirtualClock) -> None:
    before = clock.now_s()
    clock.sleep(-5)
    clock.sleep(0)
    assert 0 <= clock.now_s() - before < 1


def test_the_systems_clock_sleeps_and_knows_its_time_zone() -> None:
    clock = SystemClock()
    before = clock.now_s()
    clock.sleep(0.05)
    assert clock.now_s() - before >= 0.05
    assert abs(clock.wall() - datetime.now(UTC)) < timedelta(seconds=5)
    assert clock.wall().utcoffset() == timedelta(0)


@pytest.mark.parametrize("budget_s", [0, -1, -0.0, math.nan, math.inf, -math.inf])
def test_invalid_budget_is_refused(budget_s: float) -> None:
    with pytest.raises(SettingError, match="is not a time") as refused:
        Deadline.after(VirtualClock(), budget_s)
    assert "positive" in refused.value.remedy


@given(st.floats(1e-6, 1e6), st.floats(0, 1e6))
def test_time_left_is_budget_minus_elapsed(budget_s: float, used_s: float) -> None:
    clock = VirtualClock()
    deadline = Deadline.after(clock, budget_s)
    clock.sleep(used_s)
    assert deadline.left_s() == pytest.approx(budget_s - used_s, abs=1e-6)
    assert deadline.fits(deadline.left_s())
    assert not deadline.fits(deadline.left_s() + 1e-6)
