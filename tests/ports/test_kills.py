"""The eye is dark although everything above the light has failed: real processes, really killed."""

import os
import random
import signal
import time

import pytest

from device.drivers.guardian import Guardian
from device.drivers.ring import Apa102Ring
from device.errors import LightFault
from device.spec import ChainSpec
from device.values import Glow
from tests.ports.conftest import ring_rig
from tests.ports.emulators.kills import Victim
from tests.ports.emulators.wires import wires

DARK_S = 0.1  # after a process's death
LEASE_S = 0.4
LATE_S = 0.1  # a lease's end to the last LED's message, on a busy machine


@pytest.fixture(autouse=True)
def sound_wires():
    wires().break_()
    yield
    wires().break_()
    assert not wires().lit


@pytest.mark.parametrize("seed", range(8))
def test_a_killed_process_leaves_no_light(seed):
    death = Victim(wires(), LEASE_S).die(signal.SIGKILL, random.Random(seed).uniform(0, 0.5))
    assert death.dark_after_s <= DARK_S


@pytest.mark.parametrize("seed", range(3))
def test_a_stopped_process_is_dark_when_its_lease_ends(seed):
    death = Victim(wires(), LEASE_S).die(signal.SIGSTOP, random.Random(seed).uniform(0, 0.5))
    assert death.dark_after_s <= LEASE_S + LATE_S


@pytest.mark.parametrize(("end", "limit_s"), [("hang", LEASE_S + LATE_S), ("raise", DARK_S), ("exit", DARK_S)])
def test_a_process_that_ends_badly_with_the_lamp_on_leaves_no_light(end, limit_s):
    death = Victim(wires(), LEASE_S, end).end(end)
    assert death.was_lit
    assert death.dark_after_s <= limit_s


@pytest.fixture
def ring(sound_wires):
    rig = ring_rig()
    yield rig.light
    wires().break_()
    rig.close()


def test_without_its_guardian_nothing_shines(sound_wires):
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S)
        os.kill(guardian.pid, signal.SIGKILL)
        with pytest.raises(LightFault, match="guardian"), ring.on(Glow("green")):
            pytest.fail("it shone")
        assert not wires().lit
        with pytest.raises(LightFault, match="guardian"):
            ring.close()


@pytest.mark.parametrize("fault", ["spi.cut", "spi.short"])
def test_a_bus_that_does_not_take_its_message_is_a_fault_of_the_light(ring, fault):
    wires().break_(fault)
    with pytest.raises(LightFault, match="bus"), ring.on(Glow("green")):
        pytest.fail("it shone")


def test_a_bus_that_is_cut_while_the_lamp_is_on_is_darkened_by_the_guardian_once_it_is_back(sound_wires):
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S)
        with pytest.raises(LightFault), ring.on(Glow("green")):
            wires().break_("spi.cut")
        wires().break_()
        assert wires().lit
        time.sleep(LEASE_S + LATE_S)
        assert not wires().lit
        ring.close()


def test_a_ring_lights_its_own_leds_at_their_own_speed_and_full_global_brightness(ring):
    with ring.on(Glow("green", 0.5)):
        assert wires().lit == {str(led): [0, 128, 0] for led in (19, 20, 26, 29, 34, 37, 43, 44)}
        assert wires().messages[-1]["hz"] == 4_000_000
        assert wires().messages[-1]["bytes"] == 268
