"""The heartbeat of the hardware gate: edges on a line while a lease of light is live, and none without one.

The gate (hardware/dead-man.md) gives the LEDs their power for half a second after an edge. A kernel that hangs, a
computer without power, a process that is stopped: no edge, no light, whatever the LEDs have latched.
"""

from math import ceil
from threading import Event, Thread
from typing import Protocol

BEAT_S = 0.1  # a fifth of the gate's time: a late thread does not make it blink
POWER_UP_S = 0.01  # from an edge until the chain listens


class Line(Protocol):
    """What the heartbeat drives (device/drivers/gpio.py)."""

    def set(self, high: bool) -> None:
        """Drive it."""

    def close(self) -> None:
        """Let it go."""


class Heartbeat:
    """Toggles a line every tenth of a second from `start` to `stop`, and never for longer than the lease."""

    def __init__(self, line: Line) -> None:
        self._line, self._high = line, False
        self._still = Event()
        self._thread: Thread | None = None
        line.set(False)

    def start(self, lease_s: float) -> None:
        """Beat from now, at most for `lease_s` seconds; the LEDs have power when this returns."""
        self.stop()
        self._still.clear()
        self._toggle()
        self._thread = Thread(target=self._beat, args=(ceil(lease_s / BEAT_S),), daemon=True, name="heartbeat")
        self._thread.start()
        self._still.wait(POWER_UP_S)

    def stop(self) -> None:
        """Be still: the gate closes by itself."""
        self._still.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._high:  # so that the next light begins with a rising edge, the only one that the gate hears
            self._toggle()

    def close(self) -> None:
        """Be still, and let the line go."""
        self.stop()
        self._line.close()

    def _beat(self, beats: int) -> None:
        for _ in range(beats):
            if self._still.wait(BEAT_S):
                return
            self._toggle()

    def _toggle(self) -> None:
        self._high = not self._high
        self._line.set(self._high)
