"""Self-describing record of a patient, a visit or a capture: one JSON file that holds what its database rows hold.

    {"format": 1, "kind": "visit", "revision": 3, "record": {"id": ..., ...}, "sha256": "...", "mac": "..."}

`sha256` is the digest of the canonical JSON (sorted keys, no spaces) of `kind`, `revision` and `record`. The rows hold
the same revision and digest, so that a changed bit in either is detected, and the newer of the two is known. `mac` is
the HMAC-SHA-256 of `sha256` with the key of the store: who changes a file can compute its digest, but not that.
"""

import hashlib
import hmac
import json
from dataclasses import dataclass
from typing import Literal, get_args

from services.records import row_validation
from services.records.json_values import JsonObject, JsonValue

FORMAT = 1
Kind = Literal["patient", "visit", "capture"]


@dataclass(frozen=True)
class RecordDocument:
    """One revision of a record; `content` has the entries of `record`, with the id of the record as `id`."""

    kind: Kind
    revision: int
    content: JsonObject

    @property
    def id(self) -> str:
        """Id of the patient, the visit or the capture: the primary key of the row."""
        return row_validation.text(self.content["id"])

    def sha256(self) -> str:
        """Return the SHA-256 (hexadecimal) of the canonical JSON of kind, revision and content."""
        canonical = json.dumps(self._signed(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(canonical.encode()).hexdigest()

    def encoded(self, key: bytes | None = None) -> bytes:
        """Return the content of the file; without `mac` if the store has no key."""
        digest = self.sha256()
        entries = {"format": FORMAT, **self._signed(), "sha256": digest}
        if key is not None:
            entries["mac"] = _mac(key, digest)
        return json.dumps(entries, indent=1).encode()

    def _signed(self) -> JsonObject:
        return {"kind": self.kind, "revision": self.revision, "record": dict(self.content)}


def parse_document(content: bytes, key: bytes | None = None) -> RecordDocument:
    """Return the document in a file; without a key its `mac` is not checked.

    ValueError, TypeError or KeyError if it is none, or differs from its digest or `mac`.
    """
    entries = as_object(row_validation.parsed_json(content.decode()))
    kind: Kind = row_validation.one_of(entries["kind"], *get_args(Kind))
    row_validation.one_of(entries["format"], FORMAT)
    document = RecordDocument(kind, whole_number(entries["revision"]), as_object(entries["record"]))
    if document.sha256() != entries["sha256"]:
        raise ValueError("the SHA-256 of the record differs")
    if key is not None and not hmac.compare_digest(_mac(key, document.sha256()), str(entries.get("mac"))):
        raise ValueError("another program wrote the record: its HMAC differs")
    return document


def _mac(key: bytes, digest: str) -> str:
    return hmac.new(key, f"record {digest}".encode(), hashlib.sha256).hexdigest()


def as_object(value: JsonValue) -> JsonObject:
    """Return the value unchanged if it is a JSON object; ValueError otherwise."""
    if not isinstance(value, dict):
        raise ValueError(f"{type(value).__name__} where an object was kept")
    return value


def as_list(value: JsonValue) -> list[JsonValue]:
    """Return the value unchanged if it is a JSON list; ValueError otherwise."""
    if not isinstance(value, list):
        raise ValueError(f"{type(value).__name__} where a list was kept")
    return value


def whole_number(value: object) -> int:
    """Return the value unchanged if it is a whole number of at least 0; ValueError otherwise."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r:.60} where a whole number was kept")
    return value


def as_number(value: object) -> float:
    """Return the value as a float if it is a number; ValueError otherwise."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError(f"{value!r:.60} where a number was kept")
    return float(value)
