"""Single lines of the Raspberry Pi's header, through gpiod; whoever needs one takes it as an argument."""

from typing import Any

from device.errors import BusFault

_REMEDY = "Check gpio.chip and the line's number in the head file, and that no other program holds the line."


class OutputLine:
    """A line that we drive, low from the start; BusFault if it cannot be had."""

    def __init__(self, chip: str, line: int) -> None:
        self._line = line
        self._request, self._high, self._low = _requested(chip, line, output=True)

    def set(self, high: bool) -> None:
        """Drive it."""
        try:
            self._request.set_value(self._line, self._high if high else self._low)
        except OSError as error:
            raise BusFault(f"GPIO {self._line} cannot be driven: {error}", _REMEDY) from error

    def close(self) -> None:
        """Let it go."""
        self._request.release()


class InputLine:
    """A line that a button pulls to ground, with the Pi's own pull-up; BusFault if it cannot be had."""

    def __init__(self, chip: str, line: int) -> None:
        self._line = line
        self._request, self._high, _ = _requested(chip, line, output=False)

    def get(self) -> bool:
        """Whether it is pulled to ground."""
        try:
            return bool(self._request.get_value(self._line) == self._high)
        except OSError as error:
            raise BusFault(f"GPIO {self._line} cannot be read: {error}", _REMEDY) from error

    def close(self) -> None:
        """Let it go."""
        self._request.release()


def _requested(chip: str, line: int, *, output: bool) -> tuple[Any, Any, Any]:
    """The line as gpiod gives it, and its words for high (active) and low."""
    try:
        import gpiod
        from gpiod.line import Bias, Direction, Value
    except ImportError as error:
        raise BusFault(f"gpiod cannot be used: {error}", "Install python3-libgpiod or the package gpiod.") from error
    if output:
        settings = gpiod.LineSettings(direction=Direction.OUTPUT, output_value=Value.INACTIVE)
    else:
        settings = gpiod.LineSettings(direction=Direction.INPUT, bias=Bias.PULL_UP, active_low=True)
    try:
        request = gpiod.request_lines(chip, consumer="diffuscope", config={line: settings})
    except OSError as error:
        raise BusFault(f"{chip} does not give line {line}: {error}", _REMEDY) from error
    return request, Value.ACTIVE, Value.INACTIVE
