"""Base of the records that are kept as JSON: one class declares file, database JSON, wire and documentation.

The writer returns every entry that the reader was given. Missing entries have their default.
"""

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar, Self, cast

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic.dataclasses import dataclass

from services.records import row_validation
from services.records.json_values import JsonObject, JsonValue


def _describe(schema: Any, kind: type) -> None:
    """Add to the JSON schema of a record that it has further entries, and what the fields of its bases mean."""
    schema["additionalProperties"] = True
    for base in kind.__mro__[1:]:
        inherited = TypeAdapter(base).json_schema()["properties"] if dataclasses.is_dataclass(base) else {}
        for name, entry in schema["properties"].items():
            if "description" not in entry and "description" in inherited.get(name, {}):
                entry["description"] = inherited[name]["description"]


CONFIG = ConfigDict(
    use_attribute_docstrings=True, json_schema_serialization_defaults_required=True, json_schema_extra=_describe
)
_STORING = object()  # context of the serialisation for a file or a row


@dataclass(frozen=True, config=CONFIG)
class StoredRecord:
    """Record, or part of one, that is read from JSON and written again with every stored entry.

    An entry of `CHECKED` is one on which the program acts: one of a wrong type is an error. A wrong type of another
    entry gives its default.
    """

    CHECKED: ClassVar[frozenset[str]] = frozenset()
    COMPUTED: ClassVar[frozenset[str]] = frozenset()  # entries that are computed from others

    others: Mapping[str, object] = Field(default_factory=dict, kw_only=True, exclude=True)
    """Entries of the stored JSON that this release does not read, or that have another type."""

    @classmethod
    def read(cls, content: object) -> Self:
        """Return the record with this JSON content; ValueError if it is no object, or for a wrong type in `CHECKED`."""
        if not isinstance(content, Mapping):
            raise ValueError(f"{type(content).__name__} where names and values were kept")
        try:
            return cast(Self, _adapter(cast(Any, cls)).validate_python(content))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise ValueError(f"{place}: {first['msg']}") from error

    def as_json(self) -> dict[str, JsonValue]:
        """Return the record as a JSON object, with its `others`.

        NaN and infinity stay as they are. TypeError or ValueError if a value cannot be written as JSON.
        """
        adapter = _adapter(cast(Any, type(self)))
        written = adapter.dump_python(self, mode="json", context=_STORING, fallback=_plain, warnings=False)
        return cast(dict[str, JsonValue], written)

    @classmethod
    def parse(cls, stored: object) -> Self:
        """Return the record of a database column; `stored` is its JSON text. Errors as in `read`."""
        return cls.read(row_validation.parsed_json(stored))

    @model_validator(mode="wrap")
    @classmethod
    def _validated(cls, value: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Return the record of a JSON object; a value of the program is validated as it is."""
        if not isinstance(value, Mapping):
            return handler(value)
        names = {field.name for field in dataclasses.fields(cls)} - {"others"}
        entries = {name: entry for name, entry in value.items() if name in names and entry is not None}
        try:
            record = handler(entries)
        except ValidationError as error:
            wrong = {str(detail["loc"][0]) for detail in error.errors()}
            if wrong & cls.CHECKED:
                raise
            record = handler({name: entry for name, entry in entries.items() if name not in wrong})
        object.__setattr__(record, "others", _unwritten(value, record.as_json()))
        return record

    @model_serializer(mode="wrap")
    def _written(self, handler: SerializerFunctionWrapHandler, info: SerializationInfo):  # type: ignore[no-untyped-def]  # a type would replace the schema
        """Return the entries, with those of `others`: on the wire only those that are no entry of this release."""
        written = handler(self)
        if not self.others:
            return written
        if info.context is _STORING:
            return written | self.others
        known = {field.name for field in dataclasses.fields(self)} | self.COMPUTED
        return written | {name: entry for name, entry in self.others.items() if name not in known}


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _unwritten(stored: Mapping[str, JsonValue], written: JsonObject) -> dict[str, JsonValue]:
    """Return the stored entries that the writer would lose or change."""
    return {
        name: value
        for name, value in stored.items()
        if name not in written or type(written[name]) is not type(value) or written[name] != value
    }


def _plain(value: object) -> object:
    """Return a numpy value as plain numbers and lists; TypeError for a value of another type."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value)} does not belong into a report")
