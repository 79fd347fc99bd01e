"""The answers that a visit may hold, one field at a time: what each may be, and where it is kept."""

from collections.abc import Callable
from datetime import datetime, time
from typing import Any

from device.errors import InputError
from services.records.protocol import VISIONS

Judge = Callable[[Any], Any]
COMPLAINTS = ("sudden_loss", "flashes", "pain", "red", "none")
OLDEST = 125


def checked(name: str, value: Any) -> Any:
    """The value as it is kept; None, which is no answer, always may be. InputError says what else."""
    if name not in FIELDS:
        raise InputError(f"field: there is no field named {name[:40]!r}", "Reload the page and try again.")
    return None if value is None else FIELDS[name](value)


def _one_of(*choices: str) -> Judge:
    def judge(value: Any) -> Any:
        if value not in choices or not isinstance(value, str):
            raise _wrong(value, f"Choose one of: {', '.join(choices)}.")
        return value

    return judge


def _whole(most: int) -> Judge:
    def judge(value: Any) -> Any:
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
            raise _wrong(value, f"Give a whole number from 0 to {most}.")
        return value

    return judge


def _text(most: int) -> Judge:
    """Whatever anybody types, as it is: it is shown as text, never as anything else."""

    def judge(value: Any) -> Any:
        if not isinstance(value, str) or not value.strip():
            raise _wrong(value, "Type some letters or digits, or leave it empty.")
        if len(value) > most:
            raise InputError(f"value: {len(value)} characters are too long", f"Type at most {most} characters.")
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            raise InputError("value: this text has half of a character in it", "Type it again.")
        return value

    return judge


def _years(value: Any) -> Any:
    """A number of years, or the words of a tile, such as "<1" or "5-10"."""
    return _text(20)(value) if isinstance(value, str) else _whole(100)(value)


def _yes_or_no(value: Any) -> Any:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else _one_of("yes", "no")(value)


def _moment(value: Any) -> Any:
    """A date and time, or a time of day, as ISO 8601 writes it."""
    if isinstance(value, str) and len(value) <= 40 and value.isascii():
        for read in (datetime.fromisoformat, time.fromisoformat):
            try:
                read(value)
            except ValueError:
                continue
            return value
    raise _wrong(value, "Give a time such as 09:40 or 2026-03-01T09:40:00Z.")


def _complaints(value: Any) -> Any:
    """Some of those that are known; an empty list takes the answer back."""
    if not isinstance(value, list) or len(value) > len(COMPLAINTS):
        raise _wrong(value, f"Choose from: {', '.join(COMPLAINTS)}.")
    chosen = [_one_of(*COMPLAINTS)(one) for one in value]
    if len(set(chosen)) < len(chosen) or ("none" in chosen and len(chosen) > 1):
        raise _wrong(value, "Choose each complaint once, and 'none' alone.")
    return chosen or None


def _wrong(value: Any, remedy: str) -> InputError:
    said = ascii(value)
    return InputError(f"value: {said[:60]} is not an answer to this", remedy)


IDENTIFIERS: dict[str, Judge] = {"name": _text(120), "phone": _text(40), "village": _text(120)}
FIELDS: dict[str, Judge] = IDENTIFIERS | {
    "consent": _one_of("agreed", "declined"), "age": _whole(OLDEST), "sex": _one_of("woman", "man", "other"),
    "diabetes": _one_of("yes", "no", "unknown"), "diabetes_years": _years,
    "vision_od": _one_of(*VISIONS), "vision_os": _one_of(*VISIONS), "glasses": _yes_or_no,
    "drops_od": _moment, "drops_os": _moment, "complaints": _complaints,
}  # fmt: skip
