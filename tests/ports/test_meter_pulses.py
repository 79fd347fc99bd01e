"""`diffuscope meter` with the high-power ring on emulated wires: level, lengths of light and darkness, a kill."""

import os
import subprocess
import sys
import time
from itertools import pairwise

import pytest

from device.clock import SystemClock
from device.config.head_file import InstrumentSpec, load_head
from device.light_safety.dose_ledger import MemoryLedger
from services.workshop.power_meter import pulse, run_of
from tests.ports.conftest import HEAD
from tests.ports.emulators.kills import DARK_S, Sleeper
from tests.ports.emulators.wires import SINKS, emulated_buses

ROOT = HEAD.parents[2]
POWER = ROOT / "hardware" / "heads" / "imx296_power.toml"
MAX_ON_S = 1.0
LATE_S = 0.05  # the bus notes a message later than it was sent; on a busy machine by its delay more


@pytest.fixture(autouse=True)
def sound_wires():
    emulated_buses().set_faults()
    yield
    assert not emulated_buses().sinks.lit


def head_text() -> str:
    """Return the head file with its ring on the emulated bus of the TLC5971, and without the gate's line."""
    text = POWER.read_text(encoding="utf-8").replace("max_on_s = 1.0", f"max_on_s = {MAX_ON_S}")
    text = text.replace("/dev/spidev0.0", SINKS.device)
    return text.replace('[gpio]\nbackend = "gpiod"', '[gpio]\nbackend = "sim"')


@pytest.fixture
def spec(tmp_path) -> InstrumentSpec:
    (file := tmp_path / "head.toml").write_text(head_text(), encoding="utf-8")
    return load_head(file)


def test_the_ring_shines_at_the_permitted_level_and_half_of_the_time(spec):
    before = len(emulated_buses().sinks.messages)
    run = run_of(spec, None, 3.2)
    with Sleeper() as sleeper:
        begun_s = time.monotonic()
        pulse(run, MemoryLedger(SystemClock()), SystemClock(), lambda _: None)
        late_s = LATE_S + sleeper.dark_limit_s(begun_s, time.monotonic()) - DARK_S
    changes = emulated_buses().sinks.messages[before:]
    lit = [(change["at_s"], after["at_s"], change["lit"]) for change, after in pairwise(changes) if change["lit"]]
    assert len(lit) == run.count == 2
    for begin_s, end_s, leds in lit:
        assert end_s - begin_s >= run.on_s - late_s  # the end is the guard's: tests/unit/test_guard.py
        assert set(leds) == {"0", "1", "3", "4", "6", "7", "9", "10"}
        assert all(
            abs(level - run.illumination.level) <= 1 / 0xFFFF for level in leds.values()
        )  # a step of the grey scale
    pauses = [later[0] - sooner[1] for sooner, later in pairwise(lit)]
    assert min(pauses) >= run.on_s - late_s


def test_a_killed_command_leaves_no_light(spec, tmp_path):
    command = [sys.executable, "-c", "from services.cli import main; main()", "meter", "--data", str(tmp_path / "data")]
    with subprocess.Popen(
        [*command, "--head", str(tmp_path / "head.toml")],
        cwd=ROOT,
        env=os.environ.copy(),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(b"y\n")
        process.stdin.flush()
        process.stderr.readline()  # "pulse 1 of ...", printed while it is lit
        assert emulated_buses().sinks.lit
        with Sleeper() as sleeper:
            process.kill()
            process.wait()
            killed_s = time.monotonic()
            while emulated_buses().sinks.lit and time.monotonic() - killed_s < 5:
                time.sleep(0.005)
            dark_s = emulated_buses().sinks.messages[-1]["at_s"]
            limit_s = sleeper.dark_limit_s(killed_s, dark_s)
    assert dark_s - killed_s <= limit_s
