"""Types of values that can be written as JSON, for the modules that read or write stored JSON."""

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, TypeAlias, TypeVar

from pydantic import Field, PlainSerializer, WithJsonSchema

JsonValue: TypeAlias = "bool | int | float | str | list[JsonValue] | dict[str, JsonValue] | None"
JsonObject: TypeAlias = Mapping[str, JsonValue]
FormValue: TypeAlias = "str | int | bool | list[str] | None"  # answer to a form field of a visit
Value = TypeVar("Value")
OmittedIfNone = Annotated[
    Value | None, Field(exclude_if=lambda value: value is None)
]  # the key is absent without a value
Timestamp = Annotated[
    datetime,
    PlainSerializer(datetime.isoformat, return_type=str),  # pydantic would write "Z" for "+00:00"
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
