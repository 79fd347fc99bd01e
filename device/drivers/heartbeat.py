"""Heartbeat of the hardware gate: edges on a GPIO line while a lease of light is active, and none without one.

The gate (hardware/dead-man.md) powers the LEDs for half a second after an edge. Without edges the LEDs have no power:
after a kernel hang, a power failure or a stopped process, whatever the LEDs have latched.
"""

from math import ceil
from threading import Event, Thread

from device.drivers.gpio import OutputLine

BEAT_S = 0.1  # a fifth of the gate's hold time, so that a late thread does not interrupt the power
POWER_UP_S = 0.01  # from an edge until the chain accepts data


class Heartbeat:
    """Heartbeat in a thread: toggles a line every 0.1 s from `start` to `stop`, and never for longer than the lease."""

    def __init__(self, line: OutputLine) -> None:
        self._line = line
        self._high = False
        self._stopped = Event()
        self._thread: Thread | None = None
        line.set(False)

    def start(self, lease_s: float) -> None:
        """Start toggling, for at most `lease_s` seconds; the LEDs have power on return."""
        self.stop()
        self._stopped.clear()
        self._toggle()
        self._thread = Thread(target=self._beat, args=(ceil(lease_s / BEAT_S),), daemon=True, name="heartbeat")
        self._thread.start()
        self._stopped.wait(POWER_UP_S)

    def stop(self) -> None:
        """Stop toggling and leave the line low; the gate cuts the power half a second after the last edge."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._high:  # so that the next start is a rising edge: the gate reacts to no other
            self._toggle()

    def close(self) -> None:
        """Stop toggling and release the line."""
        self.stop()
        self._line.close()

    def _beat(self, beats: int) -> None:
        for _ in range(beats):
            if self._stopped.wait(BEAT_S):
                return
            self._toggle()

    def _toggle(self) -> None:
        self._high = not self._high
        self._line.set(self._high)
