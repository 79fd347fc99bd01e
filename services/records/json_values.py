"""Types of values that can be written as JSON, for the modules that read or write stored JSON."""

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, TypeAlias

from pydantic import PlainSerializer, WithJsonSchema

JsonValue: TypeAlias = "bool | int | float | str | list[JsonValue] | dict[str, JsonValue] | None"
JsonObject: TypeAlias = Mapping[str, JsonValue]
FormValue: TypeAlias = "str | int | bool | list[str] | None"  # answer to a form field of a visit
Timestamp = Annotated[
    datetime,
    PlainSerializer(datetime.isoformat, return_type=str),  # pydantic would write "Z" for "+00:00"
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
