"""Killing a process that holds the lamp, and measuring how long the eye still has light."""

import signal
import subprocess
import sys
import time
from dataclasses import dataclass

from tests.ports.emulators.wires import Wires

PATIENCE_S = 5.0
STEP_S = 0.005


@dataclass(frozen=True)
class Death:
    """How a victim died, whether the lamp was on at that moment, and how long it still was."""

    how: str
    was_lit: bool
    dark_after_s: float


class Victim:
    """A process that takes pictures with the emulated ring."""

    def __init__(self, wires: Wires, lease_s: float, end: str = "never") -> None:
        self._wires = wires
        command = [sys.executable, "-m", "tests.ports.emulators.victim", str(lease_s), end]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._hear(b"ready")

    def _hear(self, word: bytes) -> None:
        assert self._process.stdout is not None
        heard = self._process.stdout.readline().strip()
        if heard != word:
            raise RuntimeError(f"the victim said {heard!r} instead of {word!r}")

    def die(self, how: signal.Signals, after_s: float) -> Death:
        """Send a signal after a while, and wait for the dark."""
        time.sleep(after_s)
        self._process.send_signal(how)
        if how == signal.SIGKILL:
            self._process.wait()
        return self._darkness(how.name)

    def end(self, how: str) -> Death:
        """Wait until it ends by itself with the lamp on, and then for the dark."""
        self._hear(b"ending")
        return self._darkness(how)

    def _darkness(self, how: str) -> Death:
        died_s = time.monotonic()
        was_lit = bool(self._before(died_s))
        while self._wires.lit:
            if time.monotonic() - died_s > PATIENCE_S:
                return self._buried(Death(how, was_lit, float("inf")))
            time.sleep(STEP_S)
        dark_s = died_s
        for one in reversed(self._wires.messages):  # the first of the dark messages at the end
            if one["lit"]:
                break
            dark_s = one["at_s"]
        return self._buried(Death(how, was_lit, max(0.0, dark_s - died_s) if was_lit else 0.0))

    def _before(self, moment_s: float) -> dict:
        earlier = [one for one in self._wires.messages if one["at_s"] <= moment_s]
        return earlier[-1]["lit"] if earlier else {}

    def _buried(self, death: Death) -> Death:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        return death


def guardians() -> int:
    """How many guardians are still there."""
    found = subprocess.run(["pgrep", "-c", "-f", "blank.py --device"], capture_output=True, text=True, check=False)
    return int(found.stdout or 0)


def pause_until_alone() -> None:
    """Give guardians of the dead the time to end."""
    until_s = time.monotonic() + PATIENCE_S
    while guardians() and time.monotonic() < until_s:
        time.sleep(STEP_S)
