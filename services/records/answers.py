"""Form fields of a visit: validation of each answer, and the fields that identify a patient."""

from collections.abc import Callable, Sequence
from datetime import datetime, time

from device.errors import InputError
from services.records.json_values import FormValue
from services.records.programme import VISIONS

Validator = Callable[[object], FormValue]
COMPLAINTS = ("sudden_loss", "flashes", "pain", "red", "none")
SPANS = ("<1", "1-5", "5-10", ">10", "unknown")  # years
MAX_AGE_YEARS = 125


def validate_answer(name: str, value: object) -> FormValue:
    """Return the answer to the form field `name` in the form in which it is stored; None (no answer) is always valid.

    InputError for an unknown field or an invalid answer.
    """
    if name not in FIELDS:
        raise InputError(f"field: there is no field named {name[:40]!r}", "Reload the page and try again.")
    return None if value is None else FIELDS[name](value)


def _one_of(*choices: str) -> Validator:
    def validate(value: object) -> FormValue:
        return _choice(value, choices)

    return validate


def _choice(value: object, choices: Sequence[str]) -> str:
    if value not in choices or not isinstance(value, str):
        raise _wrong(value, f"Choose one of: {', '.join(choices)}.")
    return value


def _whole(most: int) -> Validator:
    def validate(value: object) -> FormValue:
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
            raise _wrong(value, f"Give a whole number from 0 to {most}.")
        return value

    return validate


def _text(most: int) -> Validator:
    """Return a validator of free text: 1 to `most` characters, not only spaces, no lone surrogates.

    Markup is allowed, because the page shows the text without interpreting it.
    """

    def validate(value: object) -> FormValue:
        if not isinstance(value, str) or not value.strip():
            raise _wrong(value, "Type some letters or digits, or leave it empty.")
        if len(value) > most:
            raise InputError(f"value: {len(value)} characters are too long", f"Type at most {most} characters.")
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            raise InputError("value: this text has half of a character in it", "Type it again.")
        return value

    return validate


def _years(value: object) -> FormValue:
    """Return a whole number of years, 0 to 100, or one of SPANS: free text would have to be encrypted."""
    return _choice(value, SPANS) if isinstance(value, str) else _whole(100)(value)


def _yes_or_no(value: object) -> FormValue:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else _one_of("yes", "no")(value)


def _moment(value: object) -> FormValue:
    """Return the value unchanged if it is an ISO 8601 date and time, or time of day; InputError otherwise."""
    if isinstance(value, str) and len(value) <= 40 and value.isascii():
        for read in (datetime.fromisoformat, time.fromisoformat):
            try:
                read(value)
            except ValueError:
                continue
            return value
    raise _wrong(value, "Give a time such as 09:40 or 2026-03-01T09:40:00Z.")


def _complaints(value: object) -> FormValue:
    """Return a list of different known complaints, with "none" only alone; None (no answer) for an empty list."""
    if not isinstance(value, list) or len(value) > len(COMPLAINTS):
        raise _wrong(value, f"Choose from: {', '.join(COMPLAINTS)}.")
    chosen = [_choice(complaint, COMPLAINTS) for complaint in value]
    if len(set(chosen)) < len(chosen) or ("none" in chosen and len(chosen) > 1):
        raise _wrong(value, "Choose each complaint once, and 'none' alone.")
    return chosen or None


def _wrong(value: object, remedy: str) -> InputError:
    shown = ascii(value)
    return InputError(f"value: {shown[:60]} is not an answer to this", remedy)


IDENTIFIERS: dict[str, Validator] = {"name": _text(120), "phone": _text(40), "village": _text(120)}
FIELDS: dict[str, Validator] = IDENTIFIERS | {
    "consent": _one_of("agreed", "declined"),
    "age": _whole(MAX_AGE_YEARS),
    "sex": _one_of("woman", "man", "other"),
    "diabetes": _one_of("yes", "no", "unknown"),
    "diabetes_years": _years,
    "vision_od": _one_of(*VISIONS),
    "vision_os": _one_of(*VISIONS),
    "glasses": _yes_or_no,
    "drops_od": _moment,
    "drops_os": _moment,
    "complaints": _complaints,
}
