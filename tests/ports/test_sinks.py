"""Ring of TLC5971 drivers over emulated wires: packets, kills, cut and stuck buses, and the blanker."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.config.head_file import SinkSpec
from device.drivers.blank import dark_frame, dark_packets, off_frames
from device.drivers.guardian import BLANK, Guardian
from device.drivers.heartbeat import Heartbeat
from device.drivers.ring import Tlc5971Ring, lit_packets
from device.errors import LightFault
from device.values import Illumination
from tests.ports.emulators.bus.chain import Chain, Sinks
from tests.ports.emulators.kills import LitProcess
from tests.ports.emulators.wires import SINKS, emulated_buses

LEASE_S = 0.4
GREEN = {"0": 1, "1": 1, "3": 1, "4": 1, "6": 1, "7": 1, "9": 1, "10": 1}
levels = st.floats(0.001, 1)


@pytest.fixture(autouse=True)
def sound_wires():
    emulated_buses().set_faults()
    yield
    emulated_buses().set_faults()
    assert not emulated_buses().sinks.lit


@pytest.fixture
def ring(sound_wires):
    light = Tlc5971Ring(SINKS, Guardian(SINKS.device, chip="tlc5971"), LEASE_S)
    yield light
    emulated_buses().set_faults()
    light.close()


def test_the_packet_is_that_of_the_data_sheet():
    """SBVS146D, 9.2.2.3: 25h, five control bits, brightness B G R, then grey scales from B3 to R0."""
    packet = lit_packets(SINKS, Illumination("red", 1.0))
    bits = f"{int.from_bytes(packet, 'big'):0224b}"
    assert len(packet) == 28
    assert (bits[:6], bits[6:11], bits[11:32]) == ("100101", "10110", "1" * 21)
    lit = [index for index in range(12) if bits[32 + 16 * index : 48 + 16 * index] == "1" * 16]
    assert lit == [0, 3, 6, 9], "B3, B2, B1, B0: outputs 11, 8, 5, 2"
    assert f"{int.from_bytes(dark_packets(1), 'big'):0224b}" == "10010100001" + "0" * 213


@given(level=levels, colour=st.sampled_from(["green", "red"]), chips=st.integers(1, 4))
def test_a_chain_of_any_length_shows_the_level_and_is_dark_after_the_blanker(level, colour, chips):
    sinks, chain = SINKS.model_copy(update={"chips": chips}), Sinks(chips)
    assert chain.lit == {}
    chain.take(lit_packets(sinks, Illumination(colour, level)))
    outputs = {output for several in sinks.colours[colour].outputs for output in several}
    assert chain.lit.keys() == outputs
    assert all(abs(shown - level) <= 1 / 0xFFFF for shown in chain.lit.values())  # one step of the grey scale
    for frame in off_frames("any", 64):
        chain.take(frame)
    assert chain.lit == {}


@given(level=levels, cut=st.integers(1, 27))
def test_a_short_message_after_a_dark_one_lights_nothing(level, cut):
    chain = Sinks()
    chain.take(dark_packets(1))
    chain.take(lit_packets(SINKS, Illumination("green", level))[:cut])
    assert chain.lit == {}
    chain.take(dark_packets(1))
    assert chain.lit == {}


def test_the_blanker_without_a_chip_darkens_a_matrix_of_either_kind():
    """A TLC5971 ignores the matrix's frame; a matrix sees its own frame last."""
    matrix, sinks = Chain(), Sinks()
    sinks.take(lit_packets(SINKS, Illumination("green")))
    sinks.take(dark_frame(64))
    assert len(sinks.lit) == 8, "so the order matters"
    matrix.take(bytes(4) + b"\xff\xff\xff\xff" * 64 + bytes(8))
    for frame in off_frames("any", 64):
        matrix.take(frame)
        sinks.take(frame)
    assert matrix.lit == {}
    assert sinks.lit == {}


@pytest.mark.parametrize("seed", range(4))
def test_a_killed_process_leaves_no_light(seed):
    result = LitProcess(emulated_buses().sinks, LEASE_S, chip="tlc5971").kill(
        signal.SIGKILL, random.Random(seed).uniform(0, 0.5)
    )
    assert result.dark_after_s <= result.limit_s


def test_a_stopped_process_is_dark_when_its_lease_expires():
    result = LitProcess(emulated_buses().sinks, LEASE_S, chip="tlc5971").kill(signal.SIGSTOP, 0.2)
    assert result.dark_after_s <= LEASE_S + result.limit_s


@pytest.mark.parametrize(("end", "lease_s"), [("hang", LEASE_S), ("raise", 0.0), ("exit", 0.0), ("heir", 0.0)])
def test_a_process_that_fails_with_the_lamp_on_leaves_no_light(end, lease_s):
    result = LitProcess(emulated_buses().sinks, LEASE_S, end, "tlc5971").await_end(end)
    assert result.was_lit
    assert result.dark_after_s <= lease_s + result.limit_s


@pytest.mark.parametrize("chip", ["tlc5971", "any"])
def test_the_blanker_darkens_a_crashed_ring(sound_wires, chip):
    wire = os.open(SINKS.device, os.O_RDWR)
    os.write(wire, lit_packets(SINKS, Illumination("green")))
    os.close(wire)
    assert emulated_buses().sinks.lit == GREEN
    subprocess.run([sys.executable, "-I", "-S", str(BLANK), "--device", SINKS.device, "--chip", chip], check=True)
    assert not emulated_buses().sinks.lit


@pytest.mark.parametrize("fault", ["spi.cut", "spi.short"])
def test_a_failed_spi_write_raises_light_fault(ring, fault):
    emulated_buses().set_faults(fault)
    with pytest.raises(LightFault, match="bus"), ring.on(Illumination("green")):
        pytest.fail("it shone")


def test_a_colour_without_leds_is_refused_and_dark(ring):
    with pytest.raises(LightFault, match="no amber LEDs"), ring.on(Illumination("amber")):
        pytest.fail("it shone")
    assert not emulated_buses().sinks.lit


def test_the_ring_sends_at_its_speed_and_only_its_colour(ring):
    with ring.on(Illumination("green")):
        assert emulated_buses().sinks.lit == GREEN
        assert emulated_buses().sinks.messages[-1]["hz"] == 4_000_000
        assert emulated_buses().sinks.messages[-1]["bytes"] == 28


class Gate:
    """Hardware gate on an emulated line: power for 0.4 s after a rising edge, here without waiting for it."""

    def __init__(self):
        self.level, self.edges, self.last_s = False, 0, None

    def set(self, high):
        if high and not self.level:
            self.edges, self.last_s = self.edges + 1, time.monotonic()
            emulated_buses().set_faults(*self.faults)
        self.level = high

    faults: tuple[str, ...] = ()

    def expire(self):
        """Let the one-shot run out: without power the chain forgets its latch."""
        emulated_buses().set_faults("power")
        wire = os.open(SINKS.device, os.O_RDWR)
        os.write(wire, b"\0")
        os.close(wire)

    def close(self):
        """Nothing to release."""


def test_a_latched_up_chip_stays_lit_until_the_gate_cuts_its_power(sound_wires):
    """No message darkens it: off() sends in vain, and only the missing edges do."""
    gate = Gate()
    ring = Tlc5971Ring(SINKS, Guardian(SINKS.device, chip="tlc5971"), LEASE_S, Heartbeat(gate))
    with ring.on(Illumination("green")):
        assert gate.edges == 1
        emulated_buses().set_faults("spi.latchup")
        gate.faults = ("spi.latchup",)
    edges = gate.edges
    assert emulated_buses().sinks.lit == GREEN, "the messages did not help"
    time.sleep(0.3)
    assert gate.edges == edges, "no edge after the light: the gate runs out 0.4 s after the last one"
    assert not gate.level
    gate.expire()
    assert not emulated_buses().sinks.lit
    emulated_buses().set_faults()
    ring.close()


def test_a_ring_that_gets_power_again_starts_dark(sound_wires):
    chain = Sinks()
    chain.take(lit_packets(SINKS, Illumination("green")))
    assert Sinks().lit == {}


@settings(max_examples=50)
@given(st.binary(min_size=0, max_size=120))
def test_noise_on_the_bus_ends_with_the_next_dark_message(noise):
    chain = Sinks()
    chain.take(noise)
    chain.take(dark_packets(1))
    assert chain.lit == {}


def test_a_ring_names_what_is_wrong_with_its_outputs():
    def spec(**changes):
        return SinkSpec.model_validate(SINKS.model_dump() | changes)

    with pytest.raises(ValueError, match="different numbers from 0 to 11"):
        spec(red=SINKS.red.model_dump() | {"outputs": ((0,), (5,), (8,), (11,))})
    with pytest.raises(ValueError, match="green draws 480 mA, more than most_ma = 400"):
        spec(most_ma=400)
    with pytest.raises(ValueError, match="one list of at least one output"):
        spec(green=SINKS.green.model_dump() | {"outputs": ((0, 1),)})
