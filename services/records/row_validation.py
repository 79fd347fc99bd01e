"""Validation of the values of one database row: an unreadable row is one damaged record; other rows are still listed.

Connections decode text with `surrogateescape` (schema.py), so bytes that are not UTF-8 reach these functions without an
error of the driver. Values that pass can be written as JSON: text without lone surrogates, and finite numbers.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import TypeVar, cast

from services.errors import RecordErased, StoreDamaged
from services.records.json_values import FormValue, JsonValue

REMEDY = "Its entry in the database is damaged. Nothing was removed from the disk. Call the technician."
# JSON that may not be writable again: NaN, infinity, a number too large for a float, a lone surrogate.
_RISKY = re.compile(r"NaN|Infinity|[0-9.][eE][+]?[0-9]{3}|[\\]u[dD][89a-fA-F]")
Item = TypeVar("Item")
Value = TypeVar("Value")


@contextmanager
def reading_record(name: object) -> Iterator[None]:
    """Convert errors of reading a row to StoreDamaged with `name`, the record's name, in its text; a context manager.

    Converted: ValueError, TypeError, KeyError, OverflowError and RecursionError.
    """
    try:
        yield
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise StoreDamaged(f"the entry of {name!a} cannot be read: {ascii(error)[:200]}", REMEDY) from error


def without_damaged(items: Sequence[Item], read: Callable[[Item], Value]) -> list[Value]:
    """Return `read(item)` of each item, without those for which `read` raises StoreDamaged or RecordErased."""
    out = []
    for item in items:
        try:
            out.append(read(item))
        except (StoreDamaged, RecordErased):
            continue
    return out


def text(value: object) -> str:
    """Return the value unchanged; ValueError if it is no text, or if its stored bytes were not UTF-8."""
    if not isinstance(value, str):
        raise ValueError(f"{type(value).__name__} where a text was kept")
    value.encode()  # UnicodeEncodeError is a ValueError
    return value


def readable_keys(values: Iterable[object]) -> list[str]:
    """Return those of the primary keys that can be asked for again: texts that were stored as UTF-8."""
    return [value for value in values if isinstance(value, str) and _is_utf8(value)]


def _is_utf8(value: str) -> bool:
    return not any("\ud800" <= letter <= "\udfff" for letter in value)


def form_value(value: object) -> FormValue:
    """Return the value unchanged if it can be the answer to a form field; ValueError for another type."""
    texts = isinstance(value, list) and all(isinstance(item, str) for item in value)
    if value is None or texts or isinstance(value, str | int):
        return cast(FormValue, value)
    raise ValueError(f"{type(value).__name__} where an answer was kept")


def one_of(value: object, *choices: Value) -> Value:
    """Return the choice that equals the value; ValueError if none does."""
    for choice in choices:
        if value == choice:
            return choice
    raise ValueError(f"{value!r:.60} is none of {choices}")


def timestamp(value: object) -> datetime:
    """Parse an ISO 8601 text and return the datetime; ValueError if it is invalid or has no time zone."""
    at = datetime.fromisoformat(text(value))
    if at.tzinfo is None:
        raise ValueError("a moment without a zone")
    return at


def parsed_json(value: object) -> JsonValue:
    """Parse a JSON text and return its value; ValueError if it is invalid or the value cannot be written as JSON again.

    Not writable: NaN, infinity and lone surrogates.
    """
    content: JsonValue = json.loads(written := text(value))
    if _RISKY.search(written):
        json.dumps(content, allow_nan=False, ensure_ascii=False).encode()
    return content
