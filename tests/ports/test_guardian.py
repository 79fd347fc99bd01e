"""Kill tests of ring and guardian: the ring is off after real processes were really killed, stopped or hung."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Event, Thread

import pytest

from device.config.head_file import ChainSpec
from device.drivers.guardian import BLANK, Guardian
from device.drivers.ring import Apa102Ring, lit_frame
from device.errors import LightFault
from device.values import Illumination
from tests.ports.conftest import ring_rig
from tests.ports.emulators.kills import DARK_S, PATIENCE_S, STEP_S, LitProcess, Sleeper, dark_limit_s
from tests.ports.emulators.wires import emulated_buses

LEASE_S = 0.4
WATCHES_THREADS = tuple(map(int, os.uname().release.split(".")[:2])) >= (6, 9)


@pytest.fixture(autouse=True)
def sound_wires():
    emulated_buses().set_faults()
    yield
    emulated_buses().set_faults()
    assert not emulated_buses().lit


@pytest.mark.parametrize("seed", range(8))
def test_a_killed_process_leaves_no_light(seed):
    result = LitProcess(emulated_buses(), LEASE_S).kill(signal.SIGKILL, random.Random(seed).uniform(0, 0.5))
    assert result.dark_after_s <= result.limit_s


@pytest.mark.parametrize("seed", range(3))
def test_a_stopped_process_is_dark_when_its_lease_expires(seed):
    result = LitProcess(emulated_buses(), LEASE_S).kill(signal.SIGSTOP, random.Random(seed).uniform(0, 0.5))
    assert result.dark_after_s <= LEASE_S + result.limit_s


@pytest.mark.parametrize(("end", "limit_s"), [("hang", LEASE_S + DARK_S), ("raise", DARK_S), ("exit", DARK_S)])
def test_a_process_that_fails_with_the_lamp_on_leaves_no_light(end, limit_s):
    result = LitProcess(emulated_buses(), LEASE_S, end).await_end(end)
    assert result.was_lit
    assert result.dark_after_s <= limit_s + result.limit_s - DARK_S


@pytest.fixture
def ring(sound_wires):
    rig = ring_rig()
    yield rig.light
    emulated_buses().set_faults()
    rig.close()


def test_without_a_guardian_the_ring_stays_off(sound_wires):
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S)
        os.kill(guardian.pid, signal.SIGKILL)
        with pytest.raises(LightFault, match="guardian"), ring.on(Illumination("green")):
            pytest.fail("it shone")
        assert not emulated_buses().lit
        with pytest.raises(LightFault, match="guardian"):
            ring.close()


@pytest.mark.parametrize("fault", ["spi.cut", "spi.short"])
def test_a_failed_spi_write_raises_light_fault(ring, fault):
    emulated_buses().set_faults(fault)
    with pytest.raises(LightFault, match="bus"), ring.on(Illumination("green")):
        pytest.fail("it shone")


def test_the_guardian_darkens_the_ring_once_a_cut_bus_is_back(sound_wires):
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S)
        with pytest.raises(LightFault), ring.on(Illumination("green")):
            emulated_buses().set_faults("spi.cut")
        emulated_buses().set_faults()
        assert emulated_buses().lit
        with Sleeper() as sleeper:
            sleeper.wait_for_dark(LEASE_S)
        assert not emulated_buses().lit
        ring.close()


def test_the_ring_lights_its_leds_at_its_spi_speed_and_full_global_brightness(ring):
    with ring.on(Illumination("green", 0.5)):
        assert emulated_buses().lit == {str(led): [0, 128, 0] for led in (19, 20, 26, 29, 34, 37, 43, 44)}
        assert emulated_buses().messages[-1]["hz"] == 4_000_000
        assert emulated_buses().messages[-1]["bytes"] == 268


def light_up(chain):
    """Light two LEDs directly on the bus, without a guardian."""
    wire = os.open(chain.device, os.O_RDWR)
    os.write(wire, lit_frame(chain, (0, 9), Illumination("red")))
    os.close(wire)


def test_the_blanker_of_a_boot_waits_for_its_bus(sound_wires):
    """Defect 7: with --insist it tries again while the bus fails; without, it ends and the LEDs stay lit."""
    chain = ChainSpec()
    light_up(chain)
    emulated_buses().set_faults("spi.cut")
    command = [sys.executable, "-I", "-S", str(BLANK), "--device", chain.device]
    assert subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode == 1
    with subprocess.Popen([*command, "--insist"]) as blanker:
        time.sleep(0.5)
        assert emulated_buses().lit
        assert blanker.poll() is None
        emulated_buses().set_faults()
        assert blanker.wait(timeout=5) == 0
    assert not emulated_buses().lit


def test_a_fork_that_holds_the_pipe_of_a_dead_parent_does_not_keep_the_light_on(sound_wires):
    """The end of the pipe is not the end of the process: a fork without exec holds a copy of the pipe."""
    result = LitProcess(emulated_buses(), 5.0, "heir").await_end("heir")
    assert result.was_lit
    assert result.dark_after_s <= result.limit_s


def test_a_light_after_the_end_of_its_lease_is_turned_off_again(sound_wires):
    """The parent may be stopped between its lease and its light, and continue much later."""
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        guardian.grant_lease(0.05)
        time.sleep(0.15)
        light_up(chain)
        with Sleeper() as sleeper:
            sleeper.wait_for_dark(0.05)
        assert not emulated_buses().lit


def test_the_end_of_a_watched_thread_darkens_the_ring_until_its_process_has_ended(sound_wires):
    """A killed process keeps its pipe until its memory is freed; meanwhile its other threads may still write."""
    chain, end = ChainSpec(), Event()
    thread = Thread(target=end.wait)
    thread.start()
    command = [sys.executable, "-I", "-S", str(BLANK), "--device", chain.device, "--guard"]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as guard,
        Sleeper() as sleeper,
    ):
        guard.stdin.write(f"watch {thread.native_id}\n".encode("ascii"))
        assert guard.stdout.read(64) == (b"ok\n" if WATCHES_THREADS else b"old\n")
        light_up(chain)
        sleeper.wait_for_dark(0)
        assert emulated_buses().lit, "the thread has not ended"
        end.set()
        thread.join()
        for _ in range(2 * WATCHES_THREADS):
            sleeper.wait_for_dark(0.05)
            assert not emulated_buses().lit
            light_up(chain)
    assert not emulated_buses().lit


def tasks_and_files() -> tuple[set[str], set[str]]:
    """Return the threads and open descriptors of this process."""
    return {task.name for task in Path("/proc/self/task").iterdir()}, set(os.listdir("/proc/self/fd"))


@pytest.mark.skipif(not WATCHES_THREADS, reason="Linux before 6.9")
def test_the_guardian_watches_its_process_and_two_threads_that_end_with_it(sound_wires):
    """One of two threads is not the last of a killed process, which waits until the kernel has freed the memory."""
    chain = ChainSpec()
    before = tasks_and_files()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        infos = [info.read_text() for info in Path(f"/proc/{guardian.pid}/fdinfo").iterdir()]
        watched = {info.split("Pid:")[1].split()[0] for info in infos if "Pid:" in info}
        threads = tasks_and_files()[0] - before[0]
        assert len(threads) == 2
        assert watched == {str(os.getpid())} | threads
    until_s = time.monotonic() + PATIENCE_S
    while tasks_and_files() != before and time.monotonic() < until_s:
        time.sleep(STEP_S)
    assert tasks_and_files() == before


def test_a_parent_that_dies_before_reading_the_answer_leaves_no_light(sound_wires):
    chain = ChainSpec()
    light_up(chain)
    assert emulated_buses().lit
    command = [sys.executable, "-I", "-S", str(BLANK), "--device", chain.device, "--guard"]
    guard = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    assert guard.stdin is not None
    assert guard.stdout is not None
    guard.stdout.close()
    guard.stdin.write(b"dark\n")
    assert guard.wait(timeout=5) == 0
    guard.stdin.close()
    assert not emulated_buses().lit


def test_the_gate_opens_before_the_light_and_power_up_colours_are_overwritten(sound_wires):
    calls = []

    class RecordingPulse:
        def start(self, lease_s):
            calls.append(("start", lease_s, len(emulated_buses().messages)))
            light_up(chain)  # arbitrary colours after power-up

        def stop(self):
            calls.append(("stop", dict(emulated_buses().lit)))

    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        ring = Apa102Ring(chain, guardian, LEASE_S, RecordingPulse())
        calls.clear()
        with ring.on(Illumination("green")):
            shown = [set(message["lit"]) for message in emulated_buses().messages[calls[0][2] :]]
        ring.close()
    assert calls[0][:2] == ("start", LEASE_S)
    assert shown == [{"0", "9"}, set(), {str(led) for led in (19, 20, 26, 29, 34, 37, 43, 44)}]
    assert calls[1] == ("stop", {}), "dark first, then no power"


def test_closing_on_a_cut_bus_raises_light_fault_and_the_guardian_keeps_retrying(sound_wires):
    chain = ChainSpec()
    guardian = Guardian(chain.device, chain.rows * chain.cols)
    guardian.grant_lease(0.05)
    light_up(chain)
    emulated_buses().set_faults("spi.cut")
    with pytest.raises(LightFault, match="goes on trying"):
        guardian.close()
    emulated_buses().set_faults()
    guardian.close()
    assert not emulated_buses().lit


def test_the_guardian_runs_before_ordinary_processes_where_that_is_permitted(sound_wires):
    """A late guardian is a fault of the product: a device that computes a picture is busy."""
    try_it = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    permitted = not subprocess.run([sys.executable, "-c", try_it], stderr=subprocess.DEVNULL).returncode
    chain = ChainSpec()
    with Guardian(chain.device, chain.rows * chain.cols) as guardian:
        assert guardian.is_real_time == permitted
        locked_kb = int(Path(f"/proc/{guardian.pid}/status").read_text().split("VmLck:")[1].split()[0])
        assert not permitted or locked_kb > 1000


@pytest.mark.parametrize(("late_s", "limit_s"), [(0.0, 0.1), (0.009, 0.1), (0.04, 0.14), (0.3, 0.25)])
def test_the_limit_of_darkness_follows_the_delay_of_a_sleep_up_to_a_quarter_second(late_s, limit_s):
    assert dark_limit_s(late_s) == pytest.approx(limit_s)
