"""The guard around a lamp: dark by default, one holder at a time, and never longer than it may be."""

import time
from types import TracebackType

import pytest

from device.clock import Clock, SystemClock, VirtualClock
from device.dose import Beam, Hazard, light_limits, radiometry
from device.errors import LightFault, LightLimit
from device.guard import GuardedLight
from device.ledger import MemoryLedger
from device.values import Glow

GREEN, RED = Glow("green"), Glow("red", 0.5)


class Lamp:
    """A lamp that remembers; `slow_s` is how long it takes to light up, `broken` makes it fail halfway."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self.glow: Glow | None = GREEN  # somebody left it on
        self.slow_s, self.broken = slow_s, False
        self.history: list[Glow | None] = []

    def on(self, glow: Glow) -> "Lamp":
        self.asked = glow
        return self

    def off(self) -> None:
        self.glow = None
        self.history.append(None)

    def __enter__(self) -> "Lamp":
        time.sleep(self.slow_s)
        self.glow = self.asked
        self.history.append(self.glow)
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
    while lamp.glow is not None:
        assert time.monotonic() - begin < patience_s, "the lamp stayed on"
        time.sleep(0.002)
    return time.monotonic() - begin


def test_a_lamp_that_was_left_on_is_dark_once_it_is_guarded(lamp: Lamp, clock: VirtualClock) -> None:
    assert lamp.glow is not None
    assert guard(lamp, clock, 1.0).glow is None
    assert lamp.glow is None


def test_it_shines_for_its_holder_and_not_a_moment_longer(guarded: GuardedLight, lamp: Lamp) -> None:
    holding = guarded.on(GREEN)
    assert lamp.glow is None
    with holding:
        assert guarded.glow == lamp.glow == GREEN
    assert lamp.glow is None


def test_an_exception_inside_leaves_it_dark_and_usable(guarded: GuardedLight, lamp: Lamp) -> None:
    with pytest.raises(KeyboardInterrupt), guarded.on(GREEN):
        raise KeyboardInterrupt
    assert lamp.glow is None
    with guarded.on(RED):
        assert lamp.glow == RED


def test_a_second_holder_is_refused_and_all_is_dark(guarded: GuardedLight, lamp: Lamp) -> None:
    with guarded.on(GREEN):
        with pytest.raises(LightLimit, match="someone else"), guarded.on(RED):
            pytest.fail("two held the lamp")
        assert lamp.glow is None  # a mistake in our own software: darkness is the only answer
    assert RED not in lamp.history
    with guarded.on(RED):
        assert lamp.glow == RED


def test_after_enough_light_only_darkness_earns_more(guarded: GuardedLight, lamp: Lamp, clock: VirtualClock) -> None:
    with guarded.on(GREEN):
        clock.sleep(0.9)
    with guarded.on(GREEN):
        clock.sleep(0.9)  # 0.9 s of debt is still less than the limit
    with pytest.raises(LightLimit, match=r"1\.8 s"), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.glow is None
    clock.sleep(0.7)
    with pytest.raises(LightLimit, match=r"1\.1 s"), guarded.on(GREEN):
        pytest.fail("it shone")
    clock.sleep(0.2)
    with guarded.on(GREEN):
        assert lamp.glow == GREEN


def test_refusals_do_not_add_to_the_debt_nor_shorten_it(guarded: GuardedLight, clock: VirtualClock) -> None:
    with guarded.on(GREEN):
        clock.sleep(1.5)
    for _ in range(4):  # darkness counts once, however often somebody asks
        with pytest.raises(LightLimit), guarded.on(GREEN):
            pytest.fail("it shone")
        clock.sleep(0.1)
    clock.sleep(0.11)
    with guarded.on(GREEN):
        pass


def test_as_much_darkness_as_light_goes_on_for_ever(guarded: GuardedLight, clock: VirtualClock) -> None:
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
        assert guarded.glow is None
        with pytest.raises(LightLimit), guarded.on(GREEN):
            pytest.fail("it shone")
    assert took_s > 0.05


def test_only_the_time_in_which_it_shone_counts_however_long_the_holder_hung(lamp: Lamp) -> None:
    clock = VirtualClock()
    guarded = guard(lamp, clock, 0.1)
    with guarded.on(GREEN):
        clock.sleep(0.05)
        wait_until_dark(lamp)
        clock.sleep(3600)
    with guarded.on(GREEN):
        assert lamp.glow == GREEN


def test_a_holder_in_time_is_not_disturbed_by_its_timer_later(lamp: Lamp) -> None:
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
    assert lamp.glow is None


def test_a_lamp_that_fails_while_it_lights_up_is_dark_and_free(guarded: GuardedLight, lamp: Lamp) -> None:
    lamp.broken = True
    with pytest.raises(LightFault), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.glow is None
    lamp.broken = False
    with guarded.on(GREEN):
        assert lamp.glow == GREEN


def test_off_from_anywhere_ends_it_and_is_harmless_twice(guarded: GuardedLight, lamp: Lamp) -> None:
    with guarded.on(GREEN):
        guarded.off()
        guarded.off()
        assert lamp.glow is None
    with guarded.on(RED):
        assert lamp.glow == RED


def test_a_holder_that_was_stopped_wakes_up_with_a_lamp_that_does_not_count_as_lit(
    guarded: GuardedLight, lamp: Lamp, clock: VirtualClock
) -> None:
    """Its guardian has darkened the ring, and its own timer has not had its turn yet."""
    with guarded.on(Glow("green")):
        clock.sleep(0.9)
        assert guarded.glow == Glow("green")
        clock.sleep(0.1)
        assert lamp.glow == Glow("green")
        assert guarded.glow is None


def test_light_brighter_than_a_retina_may_see_is_refused_dark_and_uncounted(lamp: Lamp, clock: VirtualClock) -> None:
    """Its dose would be small: the irradiance is what refuses it."""
    bright = Hazard({"green": Beam(0.440, 1e-3, 1e-6)}, light_limits())
    guarded = GuardedLight(lamp, clock, 1.0, bright, MemoryLedger(clock))
    with pytest.raises(LightLimit, match="times brighter"), guarded.on(GREEN):
        pytest.fail("it shone")
    assert lamp.glow is None
    assert guarded.ledger.spent_j_per_cm2("OD") == 0.0
    with guarded.on(Glow("green", 0.2)):
        assert lamp.glow == Glow("green", 0.2)
