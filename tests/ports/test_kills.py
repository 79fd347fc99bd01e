"""The eye is dark although everything above the light has failed: real processes, really killed."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest

from device.drivers.guardian import BLANK, Guardian
from device.drivers.ring import Apa102Ring, lit_frame
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


def light_up(chain):
    """As a process does that nobody watches any more."""
    wire = os.open(chain.device, os.O_RDWR)
    os.write(wire, lit_frame(chain, (0, 9), Glow("red")))
    os.close(wire)


def test_a_dead_owner_s_child_that_holds_its_pipe_does_not_keep_the_light_on(sound_wires):
    """The end of the pipe is not the end of the process: a fork without exec holds a copy of it."""
    death = Victim(wires(), 5.0, "heir").end("heir")
    assert death.was_lit
    assert death.dark_after_s <= DARK_S


def test_a_light_that_comes_after_its_lease_is_darkened_again(sound_wires):
    """An owner may be stopped between its promise and its light, and go on much later."""
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        guardian.lit(0.05)
        time.sleep(0.15)
        light_up(chain)
        time.sleep(0.05 + LATE_S)
        assert not wires().lit


def test_an_owner_that_dies_before_it_hears_the_answer_leaves_no_light(sound_wires):
    chain = ChainSpec()
    light_up(chain)
    assert wires().lit
    command = [sys.executable, "-I", "-S", str(BLANK), "--device", chain.device, "--guard"]
    guard = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    assert guard.stdin is not None
    assert guard.stdout is not None
    guard.stdout.close()
    guard.stdin.write(b"dark\n")
    assert guard.wait(timeout=5) == 0
    guard.stdin.close()
    assert not wires().lit


def test_the_gate_is_open_before_the_light_and_what_leds_show_at_power_up_is_overwritten(sound_wires):
    told = []

    class Pulse:
        def start(self, lease_s):
            told.append(("start", lease_s, len(wires().messages)))
            light_up(chain)  # what a chain may show when it gets power

        def stop(self):
            told.append(("stop", dict(wires().lit)))

    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S, Pulse())
        told.clear()
        with ring.on(Glow("green")):
            shown = [set(one["lit"]) for one in wires().messages[told[0][2] :]]
        ring.close()
    assert told[0][:2] == ("start", LEASE_S)
    assert shown == [{"0", "9"}, set(), {str(led) for led in (19, 20, 26, 29, 34, 37, 43, 44)}]
    assert told[1] == ("stop", {}), "dark first, then no power"
