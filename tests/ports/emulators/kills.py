"""Kill of a process that holds the lamp, and measurement of the time until the ring is off."""

import signal
import subprocess
import sys
import time
from dataclasses import dataclass

from tests.ports.emulators.wires import LoggedChain

PATIENCE_S = 5.0
STEP_S = 0.005


@dataclass(frozen=True)
class KillResult:
    """Result of a kill: signal or end, whether the lamp was on at that moment, and the time until it was off."""

    how: str
    was_lit: bool
    dark_after_s: float


class LitProcess:
    """Child process that takes pictures with the emulated ring."""

    def __init__(self, wires: LoggedChain, lease_s: float, end: str = "never", chip: str = "apa102") -> None:
        self._wires = wires
        command = [sys.executable, "-m", "tests.ports.emulators.victim", str(lease_s), end, chip]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._read_line(b"ready")

    def _read_line(self, word: bytes) -> list[bytes]:
        """Return the words after the given one."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line.startswith(word):
            raise RuntimeError(f"the victim printed {line!r} instead of {word!r}")
        return line.split()[1:]

    def kill(self, how: signal.Signals, after_s: float) -> KillResult:
        """Send a signal after a delay, and wait until the ring is off; the victim stops itself for SIGSTOP."""
        time.sleep(after_s)
        sent_s = time.monotonic()
        self._process.send_signal(signal.SIGUSR1 if how == signal.SIGSTOP else how)
        if how == signal.SIGKILL:
            self._process.wait()
        return self._wait_until_dark(how.name, sent_s)

    def await_end(self, how: str) -> KillResult:
        """Wait until the process ends by itself with the lamp on, and then until the ring is off.

        The process prints when it ends: on a busy machine this one reads the line after the ring is off.
        """
        (ended_s,) = self._read_line(b"ending")
        return self._wait_until_dark(how, float(ended_s))

    def _wait_until_dark(self, how: str, died_s: float) -> KillResult:
        was_lit = bool(self._lit_before(died_s))
        while self._wires.lit:
            if time.monotonic() - died_s > PATIENCE_S:
                return self._reaped(KillResult(how, was_lit, float("inf")))
            time.sleep(STEP_S)
        dark_s = died_s
        for one in reversed(self._wires.messages):  # the first of the trailing off messages
            if one["lit"]:
                break
            dark_s = one["at_s"]
        return self._reaped(KillResult(how, was_lit, max(0.0, dark_s - died_s) if was_lit else 0.0))

    def _lit_before(self, moment_s: float) -> dict:
        earlier = [one for one in self._wires.messages if one["at_s"] <= moment_s]
        return earlier[-1]["lit"] if earlier else {}

    def _reaped(self, death: KillResult) -> KillResult:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        return death


def guardians() -> int:
    """Return the number of running guardian processes."""
    found = subprocess.run(["pgrep", "-c", "-f", "blank.py --device"], capture_output=True, text=True, check=False)
    return int(found.stdout or 0)


def wait_for_guardians_to_end() -> None:
    """Wait until the guardians of ended processes have ended."""
    until_s = time.monotonic() + PATIENCE_S
    while guardians() and time.monotonic() < until_s:
        time.sleep(STEP_S)
