"""The tests' side of the emulated buses: starts them once, breaks and mends them, and reads what the LEDs showed."""

import atexit
import json
import os
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

SYSTEM_PYTHON = "/usr/bin/python3"  # Debian's, which has gi
_WRAPPED = "tests of the buses run under umockdev-wrapper; `make test` does that, after tests/ports/install"


@dataclass(frozen=True)
class Seen:
    """One message on the SPI wire: when it was done, how many LEDs shine since, and how it came."""

    at_s: float
    lit: int
    hz: int
    length: int


class Bus:
    """An emulator process. Its devices are /dev/spidev0.0 and /dev/i2c-1 for us and for our children."""

    def __init__(self) -> None:
        if "umockdev" not in os.environ.get("LD_PRELOAD", ""):
            raise RuntimeError(_WRAPPED)
        self._folder = TemporaryDirectory()
        self.folder = Path(self._folder.name)
        plain = {key: value for key, value in os.environ.items() if key not in ("LD_PRELOAD", "PYTHONPATH")}
        self._process = subprocess.Popen(
            [SYSTEM_PYTHON, Path(__file__).parent, self.folder],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=plain,
        )  # fmt: skip
        root = self._hear()
        if not root:
            raise RuntimeError("the emulated buses do not start; are gir1.2-umockdev-1.0 and python3-gi installed?")
        os.environ["UMOCKDEV_DIR"] = root

    def tell(self, *words: object) -> None:
        """A word of `Emulator.obey`, done when this returns."""
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()
        if self._hear() != "ok":
            raise RuntimeError(f"the emulated buses do not understand {words}")

    def rgb(self) -> list[tuple[int, int, int]]:
        """What every LED shows now, decoded from the wire."""
        return [tuple(led) for led in json.loads((self.folder / "leds.json").read_text())["rgb"]]

    def lit(self) -> set[int]:
        """Which LEDs shine now."""
        return {led for led, rgb in enumerate(self.rgb()) if any(rgb)}

    def messages(self) -> list[Seen]:
        """All that was on the SPI wire so far."""
        lines = (line.split() for line in (self.folder / "lit.log").read_text().splitlines())
        return [Seen(int(at) / 1e9, int(lit), int(hz), int(length)) for at, lit, hz, length in lines]

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=10)
        self._process.stdout.close()
        self._folder.cleanup()

    def _hear(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@cache
def the_bus() -> Bus:
    """The one emulator of this test run: the preload library looks at one root at a time."""
    bus = Bus()
    atexit.register(bus.close)
    return bus
