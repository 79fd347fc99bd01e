"""TOML file as a validated, frozen value; an error names the file, the line and the closest known key."""

import difflib
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from device.errors import SpecError
from device.user_files import read_text


class Table(BaseModel):
    """Base class of TOML tables: frozen; unknown keys, infinite values and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


T = TypeVar("T", bound=Table)
SYNTAX_REMEDY = 'Correct the line: text stands between straight quotes, as in name = "text"; a table is [name].'
LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def load_toml(path: Path, kind: type[T]) -> T:
    """Return a TOML file as a `kind`; SpecError names the file, and for an invalid value the line and the key.

    Validators get the file's folder in their context (`folder`), to resolve relative paths.
    """
    text = read_text(path)
    try:
        return kind.model_validate(tomllib.loads(text), context={"folder": path.parent})
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path} is not TOML: {error}", SYNTAX_REMEDY) from error
    except ValidationError as error:
        raise SpecError(_error_message(path, text, _first_cause(error), kind)) from error


def check_table(values: Mapping[str, object], kind: type[T], name: str) -> T:
    """Return the values of the table `name` as a `kind`; SpecError names the table and the key."""
    try:
        return kind.model_validate(dict(values))
    except ValidationError as error:
        raise SpecError(_error_message(f"[{name}]", "", _first_cause(error), kind)) from error


def _first_cause(error: ValidationError) -> Any:
    """Return the error to report: an unknown key first, because a misspelt key also makes another one missing."""
    mistakes = error.errors()
    return next((mistake for mistake in mistakes if mistake["type"] == "extra_forbidden"), mistakes[0])


def _error_message(path: Path | str, text: str, error: Any, kind: type[Table]) -> str:
    """Return the message for a validation error: file, line, key and reason; for an unknown key the closest known."""
    keys = [str(part) for part in error["loc"] if part != "[key]"]  # pydantic's mark of a wrong name of a table
    lines = (line_of(text, keys[:length]) for length in range(len(keys), 0, -1))  # of the key, else of its table
    line = next((line for line in lines if line), None)
    where = f"{path}, line {line}" if line else str(path)
    if error["type"] != "extra_forbidden":
        return f"{where}: {'.'.join(keys)}: {_reason(error, kind)}"
    near = difflib.get_close_matches(keys[-1], _known_keys(kind, keys[:-1]), n=1)
    near = near or [path for path in _key_paths(kind) if path.rpartition(".")[2] == keys[-1]]
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{where}: '{'.'.join(keys)}' is not a known key{hint}"


def _reason(error: Any, kind: type[Table]) -> str:
    """Return the reason of a validation error, with the given value and the permitted range if there is one."""
    message = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] in ("missing", "value_error"):  # no value, or already in the message
        return message
    *tables, key = (part for part in error["loc"] if isinstance(part, str))
    limits = [
        f"{phrase} {getattr(bound, name)}"
        for bound in _table(kind, tables).model_fields[key].metadata
        for name, phrase in LIMITS.items()
        if hasattr(bound, name)
    ]
    allowed = f"; allowed: {', '.join(limits)}" if limits else ""
    return f"{message}, not {repr(error['input'])[:60]}{allowed}"


def _known_keys(kind: type[Table], tables: list[str]) -> list[str]:
    """Return the permitted keys of the table nested in `kind` under the names `tables`."""
    return list(_table(kind, tables).model_fields)


def _key_paths(kind: type[Table]) -> list[str]:
    """Return the dotted paths of all permitted keys, those of outer tables before those of inner ones."""
    inner = [
        f"{name}.{path}"
        for name in kind.model_fields
        if _is_table(kind, name)
        for path in _key_paths(_table(kind, [name]))
    ]
    return [*kind.model_fields, *sorted(inner, key=lambda path: path.count("."))]


def _is_table(kind: type[Table], name: str) -> bool:
    """Return whether a key of a table is a table itself, or a list of tables."""
    annotation = kind.model_fields[name].annotation
    options = [annotation, *getattr(annotation, "__args__", ())]
    return any(isinstance(option, type) and issubclass(option, Table) for option in options)


def _table(kind: type[Table], tables: list[str]) -> type[Table]:
    """Return the model class of the table nested in `kind` under the names `tables`; list indices are skipped."""
    for table in (table for table in tables if not table.isdigit()):  # which of several [[tables]] it is
        annotation = kind.model_fields[table].annotation
        options = [annotation, *getattr(annotation, "__args__", ())]
        kind = next(option for option in options if isinstance(option, type) and issubclass(option, Table))
    return kind


def line_of(text: str, keys: list[str]) -> int | None:
    """Return the line number (from 1) of a key in a TOML text, or of its table if the key is missing; None if neither.

    `keys` are the names of the tables and of the key; the third of several [[tables]] is `tables.2`.
    """
    table = ""
    found = None
    times = Counter[str]()
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*(\[+)\s*([^\]]+?)\s*\]+", line):
            table = header[2] if header[1] == "[" else f"{header[2]}.{times[header[2]]}"
            times[header[2]] += 1
            if table == ".".join(keys):
                return number
            if table == ".".join(keys[:-1]):
                found = found or number
        elif (entry := re.match(r"\s*['\"]?([\w.-]+)['\"]?\s*=", line)) and (
            f"{table}.{entry[1]}".lstrip(".") == ".".join(keys)
        ):
            return number
    return found
