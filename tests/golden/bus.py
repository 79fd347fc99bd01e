"""Record of the buses: bytes on the emulated SPI and I2C while a head is opened, aimed, pressed, closed and killed.

The buses need umockdev, so a separate process makes the record and prints it as JSON: `umockdev-wrapper python -m
tests.golden.bus`.
"""

import itertools
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.golden import compare

ROOT = Path(__file__).parents[2]
LEASE_S, PATIENCE_S, TRIES = 30.0, 10.0, 3
WORD_BYTES = 4


def present() -> dict[str, Any]:
    """Return the record of the present code.

    Camera, ring and guardian run in real time: on a busy machine the guardian may answer too late, and the light is
    refused. Such a run ends with an error and is repeated; a difference in bytes is never repeated.
    """
    command = ["umockdev-wrapper", sys.executable, "-m", "tests.golden.bus", "record"]
    for _ in range(TRIES):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
        if done.returncode == 0:
            found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
            return found
    raise RuntimeError(done.stderr[-4000:])


def write() -> Path:
    """Write the record."""
    compare.write("bus", present())
    return compare.RECORDS / "bus.json"


class Listener:
    """The bytes on both buses, by phase."""

    def __init__(self, folder: Path) -> None:
        self._logs = {"spi": folder / "spi.jsonl", "i2c": folder / "i2c.jsonl"}
        self._read = {"spi": 0, "i2c": 0}
        self.phases: dict[str, dict[str, Any]] = {}

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Record the bytes sent inside the context under that name."""
        self._since()
        yield
        found = self._since()
        self.phases[name] = {
            "spi": [
                f"{message['hz']} Hz, mode {message['mode']}: {shortened(message['hex'])}" for message in found["spi"]
            ],
            "i2c": [as_line(message) for message in found["i2c"]],
        }

    def _since(self) -> dict[str, list[dict[str, Any]]]:
        found = {}
        for name, path in self._logs.items():
            lines = path.read_text(encoding="ascii").splitlines() if path.exists() else []
            found[name] = [json.loads(line) for line in lines[self._read[name] :]]
            self._read[name] = len(lines)
        return found


def shortened(text: str) -> str:
    """Return hexadecimal bytes in words of four; a repeated word is written once, with its count."""
    words = [text[at : at + 2 * WORD_BYTES] for at in range(0, len(text), 2 * WORD_BYTES)]
    groups = [(word, len(list(same))) for word, same in itertools.groupby(words)]
    return " ".join(word if number == 1 else f"{word}*{number}" for word, number in groups)


def as_line(message: dict[str, Any]) -> str:
    """Return one message on I2C as a line."""
    way = "read" if "read" in message else "write"
    return f"{message['chip']:#04x} {way} {message[way]}"


def record() -> dict[str, Any]:
    """Run a head through its phases on the emulated buses; needs umockdev."""
    from tests.ports import conftest  # first: adds the emulated libcamera to the path

    assert conftest.HEAD.is_file()
    from device.clock import SystemClock
    from device.head import head_memory
    from device.values import EYES, HeadIdentity
    from services.instrument.press_exposure import expose_live, expose_press
    from tests.ports.emulators.wires import emulated_buses
    from tests.ports.test_press import attach_sensor, head_with_real_drivers, reopened_head

    buses, clock = emulated_buses(), SystemClock()
    listener = Listener(buses.folder)
    buses.set_faults("memory.blank")
    attach_sensor()
    with listener.phase("open"):
        head = reopened_head()
    buses.set_faults()
    with listener.phase("aim"):
        expose_live(head, EYES, clock)
    with listener.phase("press"):
        expose_press(head, ("OD",), clock)
    with listener.phase("close"):
        head.close()
    with listener.phase("write the head's memory"), head_memory(head_with_real_drivers(), clock) as memory:
        memory.write(HeadIdentity("DS-0001", "0123456789abcdef"))
    with listener.phase("read the head's memory"), head_memory(head_with_real_drivers(), clock) as memory:
        memory.read()
    kills(listener, lambda: bool(buses.lit))
    return listener.phases


def kills(listener: Listener, is_lit: Callable[[], bool]) -> None:
    """Record the bytes sent by the guardian after its parent process is killed.

    The lamp is lit, dark again, or was never lit. The guardian darkens it at the first end of a thread and again at
    that of the process, or once if it reads both ends at once: equal messages are written once.
    """
    for name in ("lit", "dark"):
        victim = subprocess.Popen(
            [sys.executable, "-m", "tests.golden.bus", name], stdout=subprocess.PIPE, start_new_session=True
        )
        assert victim.stdout is not None
        with listener.phase(f"open the ring, then {name}"):
            assert victim.stdout.readline() == b"ready\n"
        with listener.phase(f"kill while {name}"):
            victim.send_signal(signal.SIGKILL)
            victim.wait()
            victim.stdout.read()  # returns after the end of its guardian
            wait_for(lambda: not is_lit())
            time.sleep(0.3)
        sent = listener.phases[f"kill while {name}"]
        sent["spi"] = list(dict.fromkeys(sent["spi"]))
        victim.stdout.close()
    with listener.phase("blank, as systemd calls it"):
        blank = [sys.executable, "-I", "-S", "device/drivers/blank.py", "--device", "/dev/spidev0.0"]
        subprocess.run(blank, cwd=ROOT, check=True)


def wait_for(holds: Callable[[], bool]) -> None:
    """Wait in real time for another process, guardian or bus."""
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def hold(state: str) -> None:
    """Open the ring, light it if `state` requires light, and wait for the kill."""
    from device.config.head_file import ChainSpec
    from device.drivers.guardian import Guardian
    from device.drivers.ring import Apa102Ring
    from device.values import Illumination

    chain = ChainSpec()
    ring = Apa102Ring(chain, Guardian(chain.device, chain.rows * chain.cols), LEASE_S)
    if state == "lit":
        ring.on(Illumination("green", 0.5)).__enter__()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    time.sleep(LEASE_S)


if __name__ == "__main__":
    if sys.argv[1] == "record":
        sys.stdout.write(json.dumps(record()) + "\n")
    else:
        hold(sys.argv[1])
