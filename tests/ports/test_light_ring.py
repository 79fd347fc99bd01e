"""The real ring driver on the emulated bus: what the wire carried, what the chain latched, and what breaks."""

import os
import subprocess
import sys
import time

import pytest

from device.drivers import blank
from device.drivers.guardian import Guardian
from device.drivers.ring import Apa102Ring
from device.errors import LightFault, LightLimit
from device.spec import LightSpec
from device.values import Glow
from tests.ports.emulators.bus.client import the_bus
from tests.ports.emulators.bus.rig import real_ring

GREEN = Glow("green")


@pytest.fixture
def bus():
    bus = the_bus()
    yield bus
    bus.tell("mend")


@pytest.fixture
def ring(bus):
    ring = real_ring()
    yield ring
    bus.tell("mend")
    ring.close()


def test_every_message_is_a_whole_frame_at_our_own_speed(bus, ring):
    before = len(bus.messages())
    with ring.on(GREEN):
        pass
    lit, *dark = bus.messages()[before:]
    assert (lit.lit, lit.hz, lit.length) == (8, 4_000_000, 268)
    assert [(m.lit, m.hz, m.length) for m in dark] == [(0, 4_000_000, 268)] * 2  # said twice


def test_opening_darkens_what_somebody_left_on(bus, ring):
    ring.shine(GREEN, ring.colours(GREEN))
    other = real_ring()
    assert not bus.lit()
    other.close()


def test_the_chain_keeps_its_colour_when_the_bus_falls_silent(bus, ring):
    """The latch, which is why all this exists: only a frame of darkness ends the light."""
    with ring.on(GREEN):
        before = len(bus.messages())
        bus.tell("celsius", 25)  # the bus lives, the wire is silent
        assert len(bus.messages()) == before
        assert bus.lit() == {19, 20, 26, 29, 34, 37, 43, 44}
    assert not bus.lit()


def test_single_leds_can_be_lit(bus, ring):
    with ring.on(Glow("red", 0.2), leds=[0]):
        assert bus.rgb()[0] == (51, 0, 0)
        assert bus.lit() == {0}


def test_a_dead_led_is_dark_to_who_looks(bus, ring):
    bus.tell("dead", 26)
    with ring.on(GREEN):
        assert bus.lit() == set(ring.leds) - {26}


def test_too_much_current_is_refused_before_the_wire(bus, ring):
    before = len(bus.messages())
    with pytest.raises(LightLimit, match="1280 mA"):
        ring.on(GREEN, leds=range(64))
    assert len(bus.messages()) == before


@pytest.mark.parametrize(("fault", "said"), [("spi.short", "cut the colours short"), ("spi.error", "does not take")])
def test_a_bus_that_fails_is_a_named_fault_and_the_guardian_ends_what_it_left(bus, ring, fault, said):
    with pytest.raises(LightFault, match=said), ring.on(GREEN):
        bus.tell("fault", fault)
    bus.tell("mend")
    ring.off()
    assert not bus.lit()
    bus.tell("fault", fault)
    with pytest.raises(LightFault, match=said), ring.on(GREEN):
        pytest.fail("never lit")


def test_a_missing_bus_says_how_to_switch_it_on(bus):
    guardian = Guardian("/dev/spidev0.0")
    with pytest.raises(LightFault) as missing:
        Apa102Ring(LightSpec(backend="apa102", spi_device="/dev/spidev9.9"), guardian)
    guardian.close()
    assert "dtparam=spi=on" in missing.value.remedy


def test_without_a_living_guardian_there_is_no_light(bus, ring):
    os.kill(ring.guardian.pid, 9)
    before = len(bus.messages())
    with pytest.raises(LightFault, match="guardian"), ring.on(GREEN):
        pytest.fail("never lit")
    assert all(message.lit == 0 for message in bus.messages()[before:])


def test_the_guardian_ends_a_lease_that_nobody_ends_and_the_ring_knows(bus):
    ring = real_ring(max_on_s=0.1)
    ring.shine(GREEN, ring.colours(GREEN))
    lit = bus.messages()[-1]
    time.sleep(0.25)
    assert ring.glow is None
    dark = next(message for message in bus.messages() if message.at_s > lit.at_s and message.lit == 0)
    assert 0.09 < dark.at_s - lit.at_s < 0.2
    with ring.on(GREEN):
        assert ring.glow == GREEN
        assert len(bus.lit()) == 8
    ring.close()


def test_a_closed_ring_stays_dark_and_closing_twice_is_harmless(bus, ring):
    ring.close()
    ring.close()
    ring.off()
    with pytest.raises(LightFault, match="closed"), ring.on(GREEN):
        pytest.fail("never lit")


def test_the_blanker_needs_nothing_but_python(bus, ring):
    ring.shine(GREEN, ring.colours(GREEN))
    assert bus.lit()
    command = [sys.executable, "-I", "-S", blank.__file__, "--device", "/dev/spidev0.0"]
    assert subprocess.run(command, check=False).returncode == 0
    assert not bus.lit()
    assert bus.messages()[-1].hz == 4_000_000
    bus.tell("fault", "spi.error")
    failed = subprocess.run(command, check=False, capture_output=True, text=True)
    assert failed.returncode == 1
    assert "could not be darkened" in failed.stderr
