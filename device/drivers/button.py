"""The shutter's button: a line to ground."""

from typing import Protocol

from device.clock import Clock


class Line(Protocol):
    """What the button pulls (device/drivers/gpio.py)."""

    def get(self) -> bool:
        """Whether it is pulled to ground."""

    def close(self) -> None:
        """Let it go."""


class GpioButton:
    """A Button on a line that is looked at, not waited for: who never looks never hears."""

    def __init__(self, line: Line, clock: Clock) -> None:
        self._line, self._clock = line, clock
        self._since_s: float | None = None

    def pressed_since_s(self) -> float | None:
        """The moment at which the press was first seen; None while it is not pressed. BusFault if unreadable."""
        if not self._line.get():
            self._since_s = None
        elif self._since_s is None:
            self._since_s = self._clock.now_s()
        return self._since_s

    def close(self) -> None:
        """Let the line go."""
        self._line.close()
