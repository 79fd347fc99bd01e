"""Numbers for people: a prefix, a counter and a check digit that catches a mistyped or swapped digit."""

import re

from device.errors import InputError

# Damm 2004: a quasigroup of order 10 without any x*y = y*x; catches all single errors and all neighbours swapped.
DAMM = (
    "0317598642", "7092154863", "4206871359", "1750983426", "6123045978",
    "3674209581", "5869720134", "8945362017", "9438617205", "2581436790",
)  # fmt: skip
LEAST_DIGITS = 4
_NUMBER = re.compile(r"[A-Z0-9][A-Z0-9-]{0,19}")


def check_digit(digits: str) -> str:
    """The digit that makes `digits` + it a checked number."""
    state = 0
    for digit in digits:
        state = int(DAMM[state][int(digit)])
    return str(state)


def numbered(prefix: str, counter: int) -> str:
    """The automatic number of a counter: A00013 is the first one of prefix A."""
    digits = f"{counter:0{LEAST_DIGITS}}"
    return f"{prefix}{digits}{check_digit(digits)}"


def is_checked(prefix: str, number: str) -> bool:
    """Whether a number could be an automatic one: prefix, enough digits, and the right last digit."""
    digits = number.removeprefix(prefix)
    shaped = number.startswith(prefix) and re.fullmatch(f"[0-9]{{{LEAST_DIGITS + 1},}}", digits, re.ASCII) is not None
    return shaped and check_digit(digits) == "0"


def looks_automatic(prefix: str, number: str) -> bool:
    """Whether somebody who types this number means an automatic one."""
    return bool(prefix) and re.fullmatch(f"{re.escape(prefix)}[0-9]+", number, re.ASCII) is not None


def whole(number: str) -> str:
    """A number whose check digit stands apart, as the page shows it (A0001-3), in one piece; others as they are."""
    apart = re.fullmatch(rf"([A-Z]+)([0-9]{{{LEAST_DIGITS},}})-([0-9])", number, re.ASCII)
    return "".join(apart.groups()) if apart and check_digit(apart[2] + apart[3]) == "0" else number


def tidy(number: str) -> str:
    """A number as it is kept: capitals, no spaces around, in one piece; InputError where it cannot be one."""
    tidied = whole(number.strip().upper())
    if not _NUMBER.fullmatch(tidied):
        remedy = "Type up to 20 letters, digits or hyphens, or leave it empty for the next number."
        raise InputError(f"number: {number[:40]!r} is not a number of a person", remedy)
    return tidied
