"""Tests of the gate heartbeat and the button on simulated lines: a GPIO emulator would need a kernel module."""

import time

import pytest

from device.clock import VirtualClock
from device.drivers.button import GpioButton
from device.drivers.gpio import OutputLine
from device.drivers.heartbeat import BEAT_S, Heartbeat
from device.errors import BusFault

GATE_S = 0.5  # hold time of the one-shot of hardware/dead-man.md after an edge


class Gate:
    """Line that records its edges."""

    def __init__(self) -> None:
        self.high, self.closed = False, False
        self.edges_s: list[float] = []
        self.rising_s: list[float] = []  # the only edges that trigger the one-shot

    def set(self, high: bool) -> None:
        if high != self.high:
            self.edges_s.append(time.monotonic())
            if high:
                self.rising_s.append(self.edges_s[-1])
        self.high = high

    def close(self) -> None:
        self.closed = True


def test_without_a_lease_there_is_no_edge():
    gate = Gate()
    Heartbeat(gate)
    assert not gate.edges_s


def test_edges_are_closer_than_the_gate_hold_time_and_end_with_the_light():
    gate = Gate()
    pulse = Heartbeat(gate)
    begin_s = time.monotonic()
    pulse.start(5.0)
    assert gate.edges_s[0] - begin_s < 0.1, "the LEDs have power before they are turned on"
    time.sleep(6 * BEAT_S)
    pulse.stop()
    edges = len(gate.edges_s)
    assert edges >= 3
    assert max(b - a for a, b in zip(gate.edges_s, gate.edges_s[1:], strict=False)) < GATE_S
    time.sleep(2 * BEAT_S)
    assert len(gate.edges_s) == edges
    assert max(b - a for a, b in zip(gate.rising_s, gate.rising_s[1:], strict=False)) < GATE_S


@pytest.mark.parametrize("beats", [1.5, 2.5])
def test_every_light_begins_with_a_rising_edge(beats):
    gate = Gate()
    pulse = Heartbeat(gate)
    for _ in range(2):
        rising, begin_s = len(gate.rising_s), time.monotonic()
        pulse.start(5.0)
        assert len(gate.rising_s) == rising + 1
        assert gate.rising_s[-1] - begin_s < 0.1
        time.sleep(beats * BEAT_S)
        pulse.stop()
    assert not gate.high


def test_a_lease_that_is_never_stopped_expires_without_further_edges():
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
    """Simulated button line to ground."""

    def __init__(self) -> None:
        self.down = False

    def get(self) -> bool:
        return self.down

    def close(self) -> None:
        self.down = False


def test_a_button_reports_since_when_it_is_pressed():
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


def test_an_unavailable_line_raises_bus_fault_with_a_remedy():
    with pytest.raises(BusFault, match="/dev/gpiochip99") as missing:
        OutputLine("/dev/gpiochip99", 17)
    assert missing.value.remedy
