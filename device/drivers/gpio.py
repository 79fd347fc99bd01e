"""Single GPIO lines of the Raspberry Pi's header, through gpiod."""

from typing import Any

from device.errors import BusFault

_REMEDY = "Check gpio.chip and the line's number in the head file, and that no other program holds the line."


class OutputLine:
    """Output line, low from the start; BusFault if it is not available."""

    def __init__(self, chip: str, line: int) -> None:
        self._line = line
        self._request, self._high, self._low = _request_line(chip, line, output=True)

    def set(self, high: bool) -> None:
        """Drive the line high or low; BusFault if that fails."""
        try:
            self._request.set_value(self._line, self._high if high else self._low)
        except OSError as error:
            raise BusFault(f"GPIO {self._line} cannot be driven: {error}", _REMEDY) from error

    def close(self) -> None:
        """Release the line."""
        self._request.release()


class InputLine:
    """Input line for a button to ground, with the Pi's internal pull-up; BusFault if it is not available."""

    def __init__(self, chip: str, line: int) -> None:
        self._line = line
        self._request, self._high, _ = _request_line(chip, line, output=False)

    def get(self) -> bool:
        """Return whether the line is pulled to ground; BusFault if unreadable."""
        try:
            return bool(self._request.get_value(self._line) == self._high)
        except OSError as error:
            raise BusFault(f"GPIO {self._line} cannot be read: {error}", _REMEDY) from error

    def close(self) -> None:
        """Release the line."""
        self._request.release()


def _request_line(chip: str, line: int, *, output: bool) -> tuple[Any, Any, Any]:
    """Return gpiod's request of one line, and gpiod's values for active and inactive; BusFault if unavailable."""
    try:
        import gpiod
        from gpiod.line import Bias, Direction, Value
    except Exception as error:  # of another numpy's compiled part: ValueError
        raise BusFault(
            f"{chip} needs gpiod, which cannot be used: {error}", "Install gpiod (pip, 2.2 or newer)."
        ) from error
    if output:
        settings = gpiod.LineSettings(direction=Direction.OUTPUT, output_value=Value.INACTIVE)
    else:
        settings = gpiod.LineSettings(direction=Direction.INPUT, bias=Bias.PULL_UP, active_low=True)
    try:
        request = gpiod.request_lines(chip, consumer="diffuscope", config={line: settings})
    except OSError as error:
        raise BusFault(f"{chip} does not give line {line}: {error}", _REMEDY) from error
    return request, Value.ACTIVE, Value.INACTIVE
