"""Types of values that can be written as JSON, for the modules that read or write stored JSON."""

from collections.abc import Mapping
from typing import TypeAlias

JsonValue: TypeAlias = "bool | int | float | str | list[JsonValue] | dict[str, JsonValue] | None"
JsonObject: TypeAlias = Mapping[str, JsonValue]
FormValue: TypeAlias = "str | int | bool | list[str] | None"  # answer to a form field of a visit
