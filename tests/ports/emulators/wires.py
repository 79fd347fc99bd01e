"""Test side of the emulated buses: started once, faults set on command, LED states read from the log."""

import atexit
import json
import os
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from device.values import Illumination
from tests.ports.emulators.timeline import segments

SERVE = Path(__file__).parent / "bus" / "serve.py"
COLOURS = ("red", "green", "blue")
FULL = 255


class EmulatedBuses:
    """SPI and I2C of a Raspberry Pi; `ring` is the number of LEDs at full light."""

    def __init__(self, ring: int = 8) -> None:
        if "umockdev" not in os.environ.get("LD_PRELOAD", ""):
            raise RuntimeError("there are no buses here: run these tests by `make test`, or under umockdev-wrapper")
        self.ring = ring
        self.folder = Path(tempfile.mkdtemp(prefix="wires"))
        plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
        command = ["/usr/bin/python3", str(SERVE), str(self.folder)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=plain)
        atexit.register(self._end)
        assert self._process.stdout is not None
        os.environ["UMOCKDEV_DIR"] = self._process.stdout.readline().strip()
        self._log = self.folder / "spi.jsonl"
        self._read, self._seen = 0, []

    def set_faults(self, *faults: str) -> None:
        """Set the active faults; without arguments, clear them."""
        (self.folder / "faults").write_text("\n".join(faults), encoding="ascii")

    @property
    def messages(self) -> list[dict]:
        """Return all SPI messages so far: `at_s`, `hz`, `bytes`, `lit` after the message."""
        text = self._log.read_text(encoding="ascii") if self._log.exists() else ""
        whole = text[: text.rfind("\n") + 1]
        self._seen += [json.loads(line) for line in whole[self._read :].splitlines()]
        self._read = len(whole)
        return self._seen

    @property
    def lit(self) -> dict[str, list[int]]:
        """Return the LEDs that are lit now."""
        return self.messages[-1]["lit"] if self.messages else {}

    def __call__(self, begin_s: float, end_s: float) -> list[tuple[Illumination | None, float]]:
        """Return the ring's illumination between two moments, decoded from the bytes: a Lamp for an emulated sensor."""
        changes = [(0.0, None)] + [(one["at_s"], self._glow(one["lit"])) for one in self.messages]
        return segments(changes, begin_s, end_s)

    def _glow(self, lit: dict[str, list[int]]) -> Illumination | None:
        sums = [sum(levels[channel] for levels in lit.values()) for channel in range(3)]
        most = max(sums)
        return Illumination(COLOURS[sums.index(most)], min(1.0, most / (FULL * self.ring))) if most else None

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


@cache
def emulated_buses() -> EmulatedBuses:
    """Return the buses of this process, started on the first call."""
    return EmulatedBuses()
