"""Validation of the values of one row: an unreadable row is one damaged record, and the other rows are still listed.

Connections decode text with `surrogateescape` (schema.py): bytes that are not UTF-8 arrive here without an error of the
driver. Values that pass can be written as JSON: text without lone surrogates, and finite numbers.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, case, func

from device.errors import StoreDamaged
from device.values import EYES

REMEDY = "Its entry in the database is damaged. Nothing was removed from the disk. Call the technician."
# What JSON may say that cannot be written again: no number, one too large for a float, half of a character.
_RISKY = re.compile(r"NaN|Infinity|[0-9.][eE][+]?[0-9]{3}|[\\]u[dD][89a-fA-F]")
Item = TypeVar("Item")
Value = TypeVar("Value")


@contextmanager
def one_record(name: object) -> Iterator[None]:
    """Convert errors of reading a row to StoreDamaged with the record's name; a context manager.

    Converted: ValueError, TypeError, KeyError, OverflowError and RecursionError.
    """
    try:
        yield
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise StoreDamaged(f"the entry of {name!a} cannot be read: {ascii(error)[:200]}", REMEDY) from error


def readable(items: Sequence[Item], read: Callable[[Item], Value]) -> list[Value]:
    """What `read` makes of each item, without those for which it raises StoreDamaged."""
    out = []
    for item in items:
        try:
            out.append(read(item))
        except StoreDamaged:
            continue
    return out


def json_part(column: Any, path: str) -> ColumnElement[Any]:
    """What SQL's `json_extract` gives; NULL where the column is no JSON, for which that would fail the whole query."""
    return case((func.json_valid(column), func.json_extract(column, path)))


def text(value: object) -> str:
    """A text; ValueError if it is none, or was no UTF-8."""
    if not isinstance(value, str):
        raise ValueError(f"{type(value).__name__} where a text was kept")
    value.encode()  # UnicodeEncodeError is a ValueError
    return value


def one_of(value: object, *choices: Value) -> Value:
    """That of the choices; ValueError if it is none of them."""
    for choice in choices:
        if value == choice:
            return choice
    raise ValueError(f"{value!r:.60} is none of {choices}")


def moment(value: object) -> datetime:
    """A moment with its zone; ValueError if it is none."""
    at = datetime.fromisoformat(text(value))
    if at.tzinfo is None:
        raise ValueError("a moment without a zone")
    return at


def parsed(value: object) -> Any:
    """What JSON says; ValueError if it is none, or says what cannot be written as JSON again."""
    said = json.loads(written := text(value))
    if _RISKY.search(written):
        json.dumps(said, allow_nan=False, ensure_ascii=False).encode()
    return said


def report(value: object) -> dict[str, Any]:
    """The report of a capture; ValueError or KeyError if a part that programs rely on has another shape."""
    said = parsed(value)
    if not isinstance(said, dict):
        raise ValueError("a report that is no object")
    for name, check in _SHAPES.items():
        if said.get(name) is not None:
            check(said[name])
    return said


def verdict(value: object) -> dict[str, Any]:
    """Return a verdict: a mapping whose optional `word` is text; ValueError otherwise."""
    text(_mapping(value).get("word", ""))
    return dict(_mapping(value))


def _mapping(value: object) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{type(value).__name__} where names and values were kept")
    return value


def _number(value: object) -> None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise ValueError(f"{type(value).__name__} where a number was kept")


def _numbers(value: object) -> None:
    for one in _mapping(value).values():
        _number(one)


def _refraction(value: object) -> None:
    _number(_mapping(value).get("sphere"))


def _moves(value: object) -> None:
    if not isinstance(value, list):
        raise ValueError("moves that are no list")
    for one in value:
        one_of(_mapping(one)["from_eye"], *EYES)
        text(_mapping(one)["from_slot"])


_SHAPES: Mapping[str, Callable[[object], object]] = {
    "seconds": _numbers, "budget_s": _number, "refraction_dpt": _refraction, "verdict": verdict, "moved": _moves,
    "dose_j_per_cm2": _number, "visit": text, "slot": text,
}  # fmt: skip
