"""Tests of the button on the handle: each press is published once, and a silent line is no press."""

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.sim.chips import SimButton
from device.sim.world import World
from services.instrument.events import EventBus
from services.instrument.shutter_button import ShutterButton
from services.resources import HEADS


def test_each_press_is_published_once() -> None:
    clock, bus = VirtualClock(), EventBus()
    world = World(load_head(HEADS / "sim.toml"), clock)
    button = ShutterButton(SimButton(world), bus)

    def after(pressed_since_s: float | None) -> int:
        world.pressed_since_s = pressed_since_s
        button.poll()
        return [event.kind for event in bus.history].count("button")

    assert [after(since_s) for since_s in (None, 1.0, 1.0, None, 2.5, 3.5, None)] == [0, 1, 1, 1, 2, 3, 3]
    world.faults.add("bus.silent")
    assert after(9.0) == 3
    assert (button.is_readable, button.pressed_at_s) == (False, 3.5)
    world.faults.clear()
    assert after(9.0) == 4
    assert (button.is_readable, button.pressed_at_s) == (True, 9.0)


def test_a_head_without_a_button_publishes_nothing() -> None:
    bus = EventBus()
    ShutterButton(None, bus).poll()
    assert not bus.history
