"""Kill of a process that holds the lamp, and measurement of the time until the ring is off."""

import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from threading import Event, Thread
from typing import Self

from tests.ports.emulators.wires import LoggedChain

PATIENCE_S = 5.0
STEP_S = 0.005
DARK_S, MAX_DARK_S = 0.1, 0.25  # limit after the end of a process or lease, and with any delay of the machine
NEGLIGIBLE_S = 0.01  # delay of a machine that is not busy: the limit is then DARK_S


class Sleeper:
    """Thread that sleeps for a few milliseconds again and again: how much later it wakes is the machine's own delay."""

    def __init__(self) -> None:
        self._sleeps: list[tuple[float, float]] = []  # when each was due, and when it ended
        self._stop = Event()
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            due_s = time.monotonic() + STEP_S
            time.sleep(STEP_S)
            self._sleeps.append((due_s, time.monotonic()))

    def dark_limit_s(self, begin_s: float, end_s: float) -> float:
        """Return how soon the lamp must be dark in a window: DARK_S, and as much more as a sleep in it was late."""
        time.sleep(2 * STEP_S)  # the sleep that was under way at the end
        return dark_limit_s(
            max((woke - due for due, woke in self._sleeps if woke >= begin_s and due <= end_s), default=0.0)
        )

    def wait_for_dark(self, lease_s: float) -> None:
        """Wait until the lamp must be dark after a lease that begins now."""
        begin_s = time.monotonic()
        time.sleep(lease_s + DARK_S)
        time.sleep(self.dark_limit_s(begin_s, time.monotonic()) - DARK_S)


def dark_limit_s(late_s: float) -> float:
    """Return how soon the lamp must be dark on a machine that delays a sleep by `late_s`."""
    return DARK_S if late_s < NEGLIGIBLE_S else min(DARK_S + late_s, MAX_DARK_S)


@dataclass(frozen=True)
class KillResult:
    """Result of a kill: signal or end, whether the lamp was on at that moment, and the time until it was off.

    `limit_s` is how soon it had to be off on this machine, after the end of the process or of its lease.
    """

    how: str
    was_lit: bool
    dark_after_s: float
    limit_s: float


class LitProcess:
    """Child process that takes pictures with the emulated ring."""

    def __init__(self, wires: LoggedChain, lease_s: float, end: str = "never", chip: str = "apa102") -> None:
        self._wires, self._sleeper = wires, Sleeper()
        command = [sys.executable, "-m", "tests.ports.emulators.victim", str(lease_s), end, chip]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._read_line(b"ready")
        self._sleeper.__enter__()

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
                return self._reaped(KillResult(how, was_lit, float("inf"), MAX_DARK_S))
            time.sleep(STEP_S)
        dark_s = died_s
        for message in reversed(self._wires.messages):  # the first of the trailing off messages
            if message["lit"]:
                break
            dark_s = message["at_s"]
        limit_s = self._sleeper.dark_limit_s(died_s, dark_s)
        return self._reaped(KillResult(how, was_lit, max(0.0, dark_s - died_s) if was_lit else 0.0, limit_s))

    def _lit_before(self, moment_s: float) -> dict:
        earlier = [message for message in self._wires.messages if message["at_s"] <= moment_s]
        return earlier[-1]["lit"] if earlier else {}

    def _reaped(self, death: KillResult) -> KillResult:
        self._sleeper.__exit__()
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
