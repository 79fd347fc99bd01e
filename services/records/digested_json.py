"""JSON object in a file, with the SHA-256 of its other entries: one changed bit is an error and no other value."""

import hashlib
import json
from collections.abc import Mapping

from services.records.json_values import JsonObject, JsonValue

DIGEST = "sha256"


def encoded(entries: Mapping[str, JsonValue]) -> bytes:
    """Return the entries as JSON, with their digest as a further entry."""
    return json.dumps({**entries, DIGEST: _digest(entries)}, indent=1).encode()


def decoded(content: bytes) -> JsonObject:
    """Return the entries of an object that `encoded` wrote; ValueError if it has changed."""
    entries: JsonValue = json.loads(content)
    if not isinstance(entries, dict):
        raise ValueError(f"{type(entries).__name__} where an object was written")
    rest = {name: value for name, value in entries.items() if name != DIGEST}
    if entries.get(DIGEST) != _digest(rest):
        raise ValueError("its SHA-256 differs")
    return rest


def _digest(entries: Mapping[str, JsonValue]) -> str:
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()
