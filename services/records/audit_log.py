"""Audit log: an append-only file of entries, chained by keyed digests, with a head that names the last one.

    audit-log.jsonl     one line per entry: JSON with number and `mac`, HMAC-SHA-256 of the `mac` before and the entry
    audit-head.json    number and `mac` of the last entry, and their own HMAC

Without the key no entry can be changed, added, left out or moved; without the head the last ones could be cut off. An
older copy of both files is not found here, but in a backup, which has the head of its time. An entry names the user,
the action, the record and the form field, and no value: names and answers stay in the records.
"""

import hashlib
import hmac
import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from device import atomic_io
from device.clock import Clock
from services.records.json_values import JsonObject, JsonValue

log = logging.getLogger(__name__)

LOG, HEAD = "audit-log.jsonl", "audit-head.json"
MAX_TEXT = 200
KEYS = {"number", "at", "user", "action", "record", "more", "mac"}


@dataclass(frozen=True)
class AuditEntry:
    """One entry: number from 1, UTC time by the device's clock, user ("" without one), action, record, and more.

    `record`: id of a visit, capture or user, or "". `more`: values of the action, such as the form field or the HTTP
    status.
    """

    number: int
    at: str
    user: str
    action: str
    record: str
    more: Mapping[str, str]


@dataclass(frozen=True)
class AuditFinding:
    """Result of a check: number of valid entries, and what is wrong; None if everything is as it was written."""

    entries: int
    problem: str | None


class AuditLog:
    """Audit log in the folder of a store; `key`: secret key of its digests, at least 32 bytes. Thread-safe.

    Entries continue after the number of the head, so that a gap stays visible after the log was cut or changed.
    """

    def __init__(self, folder: Path, key: bytes, clock: Clock) -> None:
        self._folder, self._key, self._clock = folder, key, clock
        self._lock = Lock()
        self._last: tuple[int, str] | None = None

    def append(self, user: str, action: str, record: str = "", **more: str) -> None:
        """Append one entry durably; OSError if the disk refuses."""
        with self._lock:
            number, before = self._last or self._position()
            texts: dict[str, JsonValue] = {name: text[:MAX_TEXT] for name, text in more.items() if text}
            entry: dict[str, JsonValue] = {
                "number": number + 1,
                "at": self._clock.wall().isoformat(timespec="milliseconds"),
                "user": user[:MAX_TEXT],
                "action": action,
                "record": record[:MAX_TEXT],
                "more": texts,
            }
            mac = _mac(self._key, before, entry)
            path = self._folder / LOG
            with open(path, "ab", buffering=0, opener=atomic_io.private_opener) as file:
                file.write(_line(entry | {"mac": mac}))
            atomic_io.fsync_file(path)
            self._last = number + 1, mac
            atomic_io.write_atomically(self._folder / HEAD, _head(self._key, number + 1, mac))

    def entries(self, limit: int, user: str = "", action: str = "", record: str = "") -> list[AuditEntry]:
        """Return the newest entries of a user, action or record ("" for all), the newest first; damaged ones not."""
        wanted = {"user": user, "action": action, "record": record}
        found = [
            _entry(line)
            for line in self._lines()
            if line is not None and all(not text or line.get(name) == text for name, text in wanted.items())
        ]
        return found[: -limit - 1 : -1]

    def check(self) -> AuditFinding:
        """Check the chain of all entries and the head."""
        number, mac = 0, ""
        for line in self._lines():
            if line is None:
                return AuditFinding(number, f"the entry after number {number} cannot be read")
            if line.get("number") != number + 1 or not _is_authentic(self._key, mac, line):
                return AuditFinding(number, f"the entry after number {number} was changed, moved or left out")
            number, mac = number + 1, str(line["mac"])
        head = self._head()
        if head is None:
            return AuditFinding(number, "the head is missing or was changed")
        # A power cut may come between an entry and its head.
        if head != (number, mac) and head[0] != number - 1:
            return AuditFinding(number, f"there are {number} entries, and there were {head[0]}")
        return AuditFinding(number, None)

    def _position(self) -> tuple[int, str]:
        """Return number and `mac` after which the next entry is chained: of the last entry, or of a later head."""
        self._drop_torn_line()
        lines = [line for line in self._lines() if line is not None]
        last = (int(str(lines[-1]["number"])), str(lines[-1]["mac"])) if lines else (0, "")
        head = self._head()
        return head if head is not None and head[0] > last[0] else last

    def _drop_torn_line(self) -> None:
        """End a line that a power cut left incomplete; its request was not answered."""
        path = self._folder / LOG
        if path.exists() and (content := path.read_bytes()) and not content.endswith(b"\n"):
            atomic_io.write_atomically(path, content[: content.rfind(b"\n") + 1])

    def _lines(self) -> Iterator[JsonObject | None]:
        """Yield the entries in their order; None for a line that is no entry."""
        path = self._folder / LOG
        for line in path.read_bytes().splitlines(keepends=True) if path.exists() else []:
            try:
                entry: JsonValue = json.loads(line)
            except ValueError:
                entry = None
            yield entry if isinstance(entry, dict) and set(entry) == KEYS and _line(entry) == line else None

    def _head(self) -> tuple[int, str] | None:
        try:
            head = json.loads((self._folder / HEAD).read_bytes())
            number, mac = int(head["number"]), str(head["mac"])
            is_own = hmac.compare_digest(_head(self._key, number, mac), json.dumps(head).encode())
            return (number, mac) if is_own else None
        except (OSError, ValueError, KeyError, TypeError):
            return None


def _line(entry: JsonObject) -> bytes:
    return json.dumps(entry).encode() + b"\n"


def _mac(key: bytes, before: str, entry: JsonObject) -> str:
    return hmac.new(key, f"{before}\n{json.dumps(entry, sort_keys=True)}".encode(), hashlib.sha256).hexdigest()


def _is_authentic(key: bytes, before: str, line: JsonObject) -> bool:
    entry = {name: value for name, value in line.items() if name != "mac"}
    return hmac.compare_digest(_mac(key, before, entry), str(line["mac"]))


def _head(key: bytes, number: int, mac: str) -> bytes:
    seal = hmac.new(key, f"head {number} {mac}".encode(), hashlib.sha256).hexdigest()
    return json.dumps({"number": number, "mac": mac, "seal": seal}).encode()


def _entry(line: JsonObject) -> AuditEntry:
    more = line["more"] if isinstance(line["more"], dict) else {}
    texts = {name: str(value) for name, value in more.items()}
    at, user, action, record = (str(line[name]) for name in ("at", "user", "action", "record"))
    return AuditEntry(int(str(line["number"])), at, user, action, record, texts)
