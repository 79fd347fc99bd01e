"""Test side of the emulated buses: started once, faults set on command, LED states read from the log."""

import atexit
import json
import os
import shutil
import subprocess
import tempfile
from bisect import bisect_right
from collections.abc import Callable
from functools import cache
from operator import itemgetter
from pathlib import Path

from device.config.head_file import SinkLedSpec, SinkSpec
from device.values import Illumination
from tests.ports.emulators.timeline import segments

SERVE = Path(__file__).parent / "bus" / "serve.py"
COLOURS = ("red", "green", "blue")
FULL = 255
SINKS = SinkSpec(  # the ring of imx296_power.toml on the second bus, with 60 mA an output and red LEDs, not amber
    device="/dev/spidev1.0",
    green=SinkLedSpec(
        part="green",
        places=(37, 20, 26, 43),
        outputs=((0, 1), (3, 4), (6, 7), (9, 10)),
        wavelength_um=0.525,
        power_mw=60,
        emitter_mm=1.0,
    ),
    red=SinkLedSpec(
        part="red",
        places=(29, 19, 34, 44),
        outputs=((2,), (5,), (8,), (11,)),
        wavelength_um=0.622,
        power_mw=15,
        emitter_mm=1.0,
    ),
)


class LogTail:
    """Reader of a growing file of JSON lines: each call returns the whole lines that are new."""

    def __init__(self, path: Path) -> None:
        self._path, self._read = path, 0

    def __call__(self) -> list[dict]:
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._read)
            text = file.read()
        whole = text[: text.rfind(b"\n") + 1]
        self._read += len(whole)
        return [json.loads(line) for line in whole.splitlines()]


class LoggedChain:
    """LEDs on one emulated SPI bus: its messages so far, and what is lit, from the log of the buses."""

    def __init__(self, log: Path, illumination: Callable[[dict], Illumination | None]) -> None:
        self._illumination = illumination
        self._messages, self._lit = LogTail(log), LogTail(log)
        self._seen: list[dict] = []
        self._changes: list[tuple[float, Illumination | None]] = [(0.0, None)]

    @property
    def messages(self) -> list[dict]:
        """Return all SPI messages so far: `at_s`, `hz`, `bytes`, `lit` after the message."""
        self._seen += self._messages()
        return self._seen

    @property
    def lit(self) -> dict:
        """Return the LEDs of a matrix, or the outputs of TLC5971, that are lit now."""
        return self.messages[-1]["lit"] if self.messages else {}

    def __call__(self, begin_s: float, end_s: float) -> list[tuple[Illumination | None, float]]:
        """Return the illumination between two moments, decoded from the bytes: a Lamp for an emulated sensor."""
        self._changes += [(message["at_s"], self._illumination(message["lit"])) for message in self._lit()]
        first = bisect_right(self._changes, begin_s, key=itemgetter(0)) - 1
        return segments(self._changes[first:], begin_s, end_s)


class EmulatedBuses(LoggedChain):
    """SPI and I2C of a Raspberry Pi: a matrix of APA102, and as `sinks` a TLC5971 on a bus of its own.

    `ring` is the number of LEDs at full light.
    """

    def __init__(self, ring: int = 8) -> None:
        if "umockdev" not in os.environ.get("LD_PRELOAD", ""):
            raise RuntimeError("there are no buses here: run these tests by `make test`, or under umockdev-wrapper")
        self.ring = ring
        self.folder = Path(tempfile.mkdtemp(prefix="wires"))
        super().__init__(self.folder / "spi.jsonl", self._matrix_illumination)
        self.sinks = LoggedChain(self.folder / "sinks.jsonl", sink_illumination)
        plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
        command = ["/usr/bin/python3", str(SERVE), str(self.folder)]
        # Ctrl-C in a terminal must not end the buses before the instrument, which darkens its ring over them.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=plain, start_new_session=True
        )
        atexit.register(self._end)
        assert self._process.stdout is not None
        os.environ["UMOCKDEV_DIR"] = self._process.stdout.readline().strip()

    def set_faults(self, *faults: str) -> None:
        """Set the active faults; without arguments, clear them."""
        (self.folder / "faults").write_text("\n".join(faults), encoding="ascii")

    def _matrix_illumination(self, lit: dict[str, list[int]]) -> Illumination | None:
        sums = [sum(levels[channel] for levels in lit.values()) for channel in range(3)]
        most = max(sums)
        return Illumination(COLOURS[sums.index(most)], min(1.0, most / (FULL * self.ring))) if most else None

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate()
        shutil.rmtree(self.folder)


def sink_illumination(lit: dict[str, float]) -> Illumination | None:
    """Return the colour of SINKS whose outputs sink the most current, and its level."""
    levels = {
        colour: sum(lit.get(str(output), 0.0) for several in leds.outputs for output in several)
        / sum(map(len, leds.outputs))
        for colour, leds in SINKS.colours.items()
    }
    most = max(levels, key=levels.__getitem__)
    return Illumination(most, min(1.0, levels[most])) if levels[most] > 0 else None


@cache
def emulated_buses() -> EmulatedBuses:
    """Return the buses of this process, started on the first call."""
    return EmulatedBuses()
