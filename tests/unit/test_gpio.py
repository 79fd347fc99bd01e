"""The heartbeat of the gate and the button, on lines of our own: GPIO has no emulator without a kernel module."""

import time

import pytest

from device.clock import VirtualClock
from device.drivers.button import GpioButton
from device.drivers.gpio import OutputLine
from device.drivers.heartbeat import BEAT_S, Heartbeat
from device.errors import BusFault

GATE_S = 0.5  # how long the one-shot of hardware/dead-man.md gives power after an edge


class Gate:
    """A line that remembers its edges."""

    def __init__(self) -> None:
        self.high, self.closed = False, False
        self.edges_s: list[float] = []
        self.rising_s: list[float] = []  # the only ones that the one-shot hears

    def set(self, high: bool) -> None:
        if high != self.high:
            self.edges_s.append(time.monotonic())
            if high:
                self.rising_s.append(self.edges_s[-1])
        self.high = high

    def close(self) -> None:
        self.closed = True


def test_no_lease_no_edge():
    gate = Gate()
    Heartbeat(gate)
    assert not gate.edges_s


def test_edges_come_closer_than_the_gate_closes_and_end_with_the_light():
    gate = Gate()
    pulse = Heartbeat(gate)
    begin_s = time.monotonic()
    pulse.start(5.0)
    assert gate.edges_s[0] - begin_s < 0.1, "the LEDs have power before they are told to shine"
    time.sleep(6 * BEAT_S)
    pulse.stop()
    edges = len(gate.edges_s)
    assert edges >= 3
    assert max(b - a for a, b in zip(gate.edges_s, gate.edges_s[1:], strict=False)) < GATE_S
    time.sleep(2 * BEAT_S)
    assert len(gate.edges_s) == edges
    assert max(b - a for a, b in zip(gate.rising_s, gate.rising_s[1:], strict=False)) < GATE_S


@pytest.mark.parametrize("beats", [1.5, 2.5])
def test_every_light_begins_with_an_edge_that_the_gate_hears(beats):
    gate = Gate()
    pulse = Heartbeat(gate)
    for _ in range(2):
        heard, begin_s = len(gate.rising_s), time.monotonic()
        pulse.start(5.0)
        assert len(gate.rising_s) == heard + 1
        assert gate.rising_s[-1] - begin_s < 0.1
        time.sleep(beats * BEAT_S)
        pulse.stop()
    assert not gate.high


def test_a_holder_that_never_stops_it_outlives_its_lease_by_no_edge():
    gate = Gate()
    pulse = Heartbeat(gate)
    begin_s = time.monotonic()
    pulse.start(2 * BEAT_S)
    time.sleep(6 * BEAT_S)
    assert len(gate.edges_s) == 3
    assert gate.edges_s[-1] - begin_s < 4 * BEAT_S
    pulse.close()
    assert gate.closed


class Key:
    """A line to ground."""

    def __init__(self) -> None:
        self.down = False

    def get(self) -> bool:
        return self.down

    def close(self) -> None:
        self.down = False


def test_a_button_knows_since_when_it_is_pressed():
    key, clock = Key(), VirtualClock()
    button = GpioButton(key, clock)
    assert button.pressed_since_s() is None
    clock.sleep(3)
    key.down = True
    assert button.pressed_since_s() == 3
    clock.sleep(2)
    assert button.pressed_since_s() == 3
    key.down = False
    assert button.pressed_since_s() is None


def test_a_line_that_cannot_be_had_is_named_with_what_to_do():
    with pytest.raises(BusFault, match="/dev/gpiochip99") as missing:
        OutputLine("/dev/gpiochip99", 17)
    assert missing.value.remedy
