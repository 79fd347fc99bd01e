"""Shutter button: a GPIO line to ground."""

from device.clock import Clock
from device.drivers.gpio import InputLine


class GpioButton:
    """Button on a polled line: there are no edge events, so a press that lies between two polls is missed."""

    def __init__(self, line: InputLine, clock: Clock) -> None:
        self._line, self._clock = line, clock
        self._since_s: float | None = None

    def pressed_since_s(self) -> float | None:
        """Return the clock time, s, at which the current press was first polled; None if not pressed.

        BusFault if the line cannot be read.
        """
        if not self._line.get():
            self._since_s = None
        elif self._since_s is None:
            self._since_s = self._clock.now_s()
        return self._since_s

    def close(self) -> None:
        """Release the line."""
        self._line.close()
