"""Patient numbers: prefix, counter and check digit.

The check digit detects every single mistyped digit and every swap of two adjacent digits.
"""

import re

from device.errors import InputError

# Damm 2004: quasigroup of order 10 without x*y = y*x for x != y; detects all single errors and adjacent swaps.
DAMM = (
    "0317598642",
    "7092154863",
    "4206871359",
    "1750983426",
    "6123045978",
    "3674209581",
    "5869720134",
    "8945362017",
    "9438617205",
    "2581436790",
)
MIN_DIGITS = 4
MAX_LENGTH = 20
_NUMBER = re.compile(rf"[A-Z0-9][A-Z0-9-]{{0,{MAX_LENGTH - 1}}}")


def check_digit(digits: str) -> str:
    """Return the Damm check digit of a text of decimal digits; "0" if the last of them is their valid check digit."""
    state = 0
    for digit in digits:
        state = int(DAMM[state][int(digit)])
    return str(state)


def automatic_number(prefix: str, counter: int) -> str:
    """Return the automatic number of a counter: prefix, counter with at least 4 digits, check digit.

    The first one of prefix A is A00013: counter 0001, check digit 3.
    """
    digits = f"{counter:0{MIN_DIGITS}}"
    return f"{prefix}{digits}{check_digit(digits)}"


def has_valid_check_digit(prefix: str, number: str) -> bool:
    """Return whether a number has the form of an automatic one: prefix, at least 5 digits, valid check digit."""
    digits = number.removeprefix(prefix)
    shaped = number.startswith(prefix) and re.fullmatch(f"[0-9]{{{MIN_DIGITS + 1},}}", digits, re.ASCII) is not None
    return shaped and check_digit(digits) == "0"


def looks_automatic(prefix: str, number: str) -> bool:
    """Return whether a number is the prefix and digits only, so that it must have a valid check digit.

    False for an empty prefix.
    """
    return bool(prefix) and re.fullmatch(f"{re.escape(prefix)}[0-9]+", number, re.ASCII) is not None


def join_check_digit(number: str) -> str:
    """Return a number without the hyphen before its check digit (A0001-3 becomes A00013).

    Numbers of another form or with a wrong check digit are returned unchanged.
    """
    apart = re.fullmatch(rf"([A-Z]+)([0-9]{{{MIN_DIGITS},}})-([0-9])", number, re.ASCII)
    return "".join(apart.groups()) if apart and check_digit(apart[2] + apart[3]) == "0" else number


def with_ending(number: str, ending: str) -> str:
    """Return a number with an ending, cut before it so that the result has at most MAX_LENGTH characters."""
    return number[: MAX_LENGTH - len(ending)] + ending


def normalise(number: str) -> str:
    """Return a number in capitals, without outer spaces, and with its check digit joined (`join_check_digit`).

    InputError unless the result is 1 to 20 letters, digits or hyphens and does not start with a hyphen.
    """
    tidied = join_check_digit(number.strip().upper())
    if not _NUMBER.fullmatch(tidied):
        remedy = "Type up to 20 letters, digits or hyphens, or leave it empty for the next number."
        raise InputError(f"number: {number[:40]!r} is not a number of a patient", remedy)
    return tidied
