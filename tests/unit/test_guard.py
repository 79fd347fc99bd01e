"""Tests of the light guard: dark by default, one holder at a time, and limits on duration and irradiance."""

import time
from types import TracebackType

import pytest

from device.clock import Clock, SystemClock, VirtualClock
from device.errors import DailyLightLimit, LightFault, LightLimit, LightWithoutVisit
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.light_safety.hazard import Beam, Hazard, light_limits, radiometry
from device.values import Illumination

GREEN, RED = Illumination("green"), Illumination("red", 0.5)


class Lamp:
    """Lamp that records its states; `slow_s` is its turn-on time, `broken` makes it fail during turn-on."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self.illumination: Illumination | None = GREEN  # left on by an earlier process
        self.slow_s, self.broken = slow_s, False
        self.history: list[Illumination | None] = []

    def on(self, illumination: Illumination) -> "Lamp":
        self.asked = illumination
        return self

    def off(self) -> None:
        self.illumination = None
        self.history.append(None)

    def __enter__(self) -> "Lamp":
        time.sleep(self.slow_s)
        self.illumination = self.asked
        self.history.append(self.illumination)
        if self.broken:
            raise LightFault("half of the ring does not answer")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.off()


def guard(lamp: Lamp, clock: Clock, max_on_s: float) -> GuardedLight:
    return GuardedLight(lamp, clock, max_on_s, Hazard(radiometry(), light_limits()), MemoryLedger(clock))


@pytest.fixture
def lamp() -> Lamp:
    return Lamp()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def guarded(lamp: Lamp, clock: VirtualClock) -> GuardedLight:
    return guard(lamp, clock, 1.0)


def wait_until_dark(lamp: Lamp, patience_s: float = 10.0) -> float:
    begin = time.monotonic()
    while lamp.illumination is not None:
        assert time.monotonic() - begin < patience_s, "the lamp stayed on"
        time.sleep(0.002)
    return time.monotonic() - begin


def test_a_lamp_that_was_left_on_is_dark_once_it_is_guarded(lamp: Lamp, clock: VirtualClock) -> None:
    assert lamp.illumination is not None
    assert guard(lamp, clock, 1.0).illumination is None
    assert lamp.illumination is None


def test_the_lamp_is_on_only_within_the_context(guarded: GuardedLight, lamp: Lamp) -> None:
    holding = guarded.on(GREEN)
    assert lamp.illumination is None
    with holding:
        assert guarded.illumination == lamp.illumination == GREEN
    assert lamp.illumination is None


def test_an_exception_inside_leaves_the_lamp_off_and_usable(guarded: GuardedLight, lamp: Lamp) -> None:
    with pytest.raises(KeyboardInterrupt), guarded.on(GREEN):
        raise KeyboardInterrupt
    assert lamp.illumination is None
    with guarded.on(RED):
        assert lamp.illumination == RED


def test_a_second_holder_is_refused_and_the_lamp_is_off(guarded: GuardedLight, lamp: Lamp) -> None:
    with guarded.on(GREEN):
        with pytest.raises(LightLimit, match="someone else"), guarded.on(RED):
            pytest.fail("two held the lamp")
        assert lamp.illumination is None  # an error in our own software: turn the lamp off
    assert RED not in lamp.history
    with guarded.on(RED):
        assert lamp.illumination == RED


def test_more_light_needs_as_much_darkness(guarded: GuardedLight, lamp: Lamp, clock: VirtualClock) -> None:
    with guarded.on(GREEN):
        clock.sleep(0.9)
    with guarded.on(GREEN):
        clock.sleep(0.9)  # 0.9 s of debt is still less than the limit
    with pytest.raises(LightLimit, match=r"1\.8 s"), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.illumination is None
    clock.sleep(0.7)
    with pytest.raises(LightLimit, match=r"1\.1 s"), guarded.on(GREEN):
        pytest.fail("it shone")
    clock.sleep(0.2)
    with guarded.on(GREEN):
        assert lamp.illumination == GREEN


def test_refusals_do_not_change_the_light_debt(guarded: GuardedLight, clock: VirtualClock) -> None:
    with guarded.on(GREEN):
        clock.sleep(1.5)
    for _ in range(4):  # darkness counts once, however often light is requested
        with pytest.raises(LightLimit), guarded.on(GREEN):
            pytest.fail("it shone")
        clock.sleep(0.1)
    clock.sleep(0.11)
    with guarded.on(GREEN):
        pass


def test_equal_light_and_darkness_can_continue_without_limit(guarded: GuardedLight, clock: VirtualClock) -> None:
    for _ in range(100):
        with guarded.on(RED):
            clock.sleep(0.05)
        clock.sleep(0.05)
    with guarded.on(GREEN):
        clock.sleep(0.1)


def test_the_timer_darkens_a_lamp_whose_holder_hangs(lamp: Lamp) -> None:
    guarded = guard(lamp, SystemClock(), 0.1)
    with guarded.on(GREEN):
        took_s = wait_until_dark(lamp)
        time.sleep(0.3)  # the holder still hangs
        assert guarded.illumination is None
        with pytest.raises(LightLimit), guarded.on(GREEN):
            pytest.fail("it shone")
    assert took_s > 0.05


def test_only_the_lit_time_of_a_hung_holder_counts(lamp: Lamp) -> None:
    clock = VirtualClock()
    guarded = guard(lamp, clock, 0.1)
    with guarded.on(GREEN):
        clock.sleep(0.05)
        wait_until_dark(lamp)
        clock.sleep(3600)
    with guarded.on(GREEN):
        assert lamp.illumination == GREEN


def test_the_timer_is_cancelled_when_the_context_ends(lamp: Lamp) -> None:
    guarded = guard(lamp, SystemClock(), 0.2)
    with guarded.on(GREEN):
        pass
    dark = len(lamp.history)
    time.sleep(0.35)
    assert len(lamp.history) == dark  # the timer was cancelled


def test_a_lamp_slower_than_its_timer_does_not_stay_on(clock: VirtualClock) -> None:
    lamp = Lamp(slow_s=0.3)
    guarded = guard(lamp, clock, 0.05)
    with pytest.raises(LightLimit, match="longer"), guarded.on(GREEN):
        pytest.fail("it shone without a timer")
    assert lamp.illumination is None


def test_a_lamp_that_fails_while_it_lights_up_is_dark_and_free(guarded: GuardedLight, lamp: Lamp) -> None:
    lamp.broken = True
    with pytest.raises(LightFault), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.illumination is None
    lamp.broken = False
    with guarded.on(GREEN):
        assert lamp.illumination == GREEN


def test_off_ends_the_light_and_is_idempotent(guarded: GuardedLight, lamp: Lamp) -> None:
    with guarded.on(GREEN):
        guarded.off()
        guarded.off()
        assert lamp.illumination is None
    with guarded.on(RED):
        assert lamp.illumination == RED


def test_after_max_on_s_the_lamp_is_reported_as_off(guarded: GuardedLight, lamp: Lamp, clock: VirtualClock) -> None:
    """The guardian has darkened the ring, and the guard's own timer has not fired yet."""
    with guarded.on(Illumination("green")):
        clock.sleep(0.9)
        assert guarded.illumination == Illumination("green")
        clock.sleep(0.1)
        assert lamp.illumination == Illumination("green")
        assert guarded.illumination is None


def test_light_above_the_irradiance_limit_is_refused_and_not_counted(lamp: Lamp, clock: VirtualClock) -> None:
    """The dose would be small: the irradiance limit refuses the light."""
    bright = Hazard({"green": Beam(0.440, 1e-3, 1e-6)}, light_limits())
    guarded = GuardedLight(lamp, clock, 1.0, bright, MemoryLedger(clock))
    with pytest.raises(LightLimit, match="times brighter"), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.illumination is None
    assert guarded.ledger.spent_j_per_cm2("OD") == 0.0
    with guarded.on(Illumination("green", 0.1)):
        assert lamp.illumination == Illumination("green", 0.1)


def test_light_without_a_visit_has_a_lower_limit(guarded: GuardedLight, lamp: Lamp, clock: VirtualClock) -> None:
    """Light without a visit leaves at least half of a day's dose to a visit."""
    limits = light_limits()
    lower, stop = limits.stop_without_visit_j_per_cm2, limits.stop_j_per_cm2
    guarded.ledger.reserve(("OD",), lower, stop)
    with pytest.raises(LightWithoutVisit, match="without a visit: the right eye") as refused, guarded.on(GREEN):
        pytest.fail("light without a visit")
    assert (lamp.illumination, guarded.ledger.spent_j_per_cm2("OD")) == (None, lower)
    assert "Begin a visit" in refused.value.remedy
    assert refused.value.n is not None
    with guarded.on(GREEN, ("OS",)):
        assert lamp.illumination == GREEN
    clock.sleep(10.0)
    with guarded.on(GREEN, ("OD",), in_visit=True):
        assert lamp.illumination == GREEN


def test_beyond_the_limit_of_the_day_no_visit_is_asked_for(guarded: GuardedLight) -> None:
    stop_j_per_cm2 = light_limits().stop_j_per_cm2
    guarded.ledger.reserve(("OD",), stop_j_per_cm2, stop_j_per_cm2)
    for in_visit in (False, True):
        with pytest.raises(DailyLightLimit), guarded.on(GREEN, ("OD",), in_visit=in_visit):
            pytest.fail("it shone")
