"""A TOML file as a checked, frozen value: a mistake is named with its file, its line, and the key that was meant."""

import difflib
import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from device.errors import SpecError


class Table(BaseModel):
    """A TOML table: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


T = TypeVar("T", bound=Table)
LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def load_toml(path: Path, kind: type[T]) -> T:
    """Read a TOML file as a `kind`; SpecError names the file, the line and the key of the first mistake.

    Validators find the file's folder in their context, so that paths can be meant from there.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path} cannot be read: {error}", "Give the path of a readable TOML file.") from error
    try:
        return kind.model_validate(tomllib.loads(text), context={"folder": path.parent})
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path} is not TOML: {error}") from error
    except ValidationError as error:
        raise SpecError(_sentence(path, text, _most_telling(error), kind)) from error


def _most_telling(error: ValidationError) -> Any:
    """The mistake to name: a key that is not known comes first, because it is why another one is missing."""
    mistakes = error.errors()
    return next((mistake for mistake in mistakes if mistake["type"] == "extra_forbidden"), mistakes[0])


def _sentence(path: Path, text: str, error: Any, kind: type[Table]) -> str:
    keys = [str(part) for part in error["loc"]]
    lines = (line_of(text, keys[:length]) for length in range(len(keys), 0, -1))  # of the key, or what it stands in
    line = next((line for line in lines if line), None)
    where = f"{path}, line {line}" if line else str(path)
    if error["type"] != "extra_forbidden":
        return f"{where}: {'.'.join(keys)}: {_complaint(error, kind)}"
    near = difflib.get_close_matches(keys[-1], _known_keys(kind, keys[:-1]), n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{where}: '{'.'.join(keys)}' is not a known key{hint}"


def _complaint(error: Any, kind: type[Table]) -> str:
    """What is wrong, with the value that was given and all that is allowed."""
    words = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] in ("missing", "value_error"):  # there is no value, or the words hold it
        return words
    *tables, key = (part for part in error["loc"] if isinstance(part, str))
    limits = [
        f"{phrase} {getattr(bound, name)}"
        for bound in _table(kind, tables).model_fields[key].metadata
        for name, phrase in LIMITS.items()
        if hasattr(bound, name)
    ]
    allowed = f"; allowed: {', '.join(limits)}" if limits else ""
    return f"{words}, not {repr(error['input'])[:60]}{allowed}"


def _known_keys(kind: type[Table], tables: list[str]) -> list[str]:
    return list(_table(kind, tables).model_fields)


def _table(kind: type[Table], tables: list[str]) -> type[Table]:
    for table in (table for table in tables if not table.isdigit()):  # which of several [[tables]] it is
        annotation = kind.model_fields[table].annotation
        options = [annotation, *getattr(annotation, "__args__", ())]
        kind = next(option for option in options if isinstance(option, type) and issubclass(option, Table))
    return kind


def line_of(text: str, keys: list[str]) -> int | None:
    """The line of a TOML text (counted from 1) on which a key stands, or its table's, if it is missing.

    The third of several [[tables]] is called `tables.2`.
    """
    table, found, times = "", None, Counter[str]()
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*(\[+)\s*([^\]]+?)\s*\]+", line):
            table = header[2] if header[1] == "[" else f"{header[2]}.{times[header[2]]}"
            times[header[2]] += 1
            if table == ".".join(keys) or table == ".".join(keys[:-1]):
                found = found or number
        elif (entry := re.match(r"\s*['\"]?([\w.-]+)['\"]?\s*=", line)) and (
            f"{table}.{entry[1]}".lstrip(".") == ".".join(keys)
        ):
            return number
    return found
