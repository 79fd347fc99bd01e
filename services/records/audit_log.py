"""Audit log: an append-only file of entries, chained by keyed digests, with a head that names the last one.

    audit-log.jsonl     one line per entry: JSON with number and `mac`, HMAC-SHA-256 of the `mac` before and the entry
    audit-head.json    number and `mac` of the last entry, and of the last one that was archived, and their own HMAC

Without the key no entry can be changed, added, left out or moved; without the head the last ones could be cut off. An
older copy of both files is not found here, but in a backup, which has the head of its time. An entry names the user,
the action, the record and the form field, and no value: names and answers stay in the records.
"""

import hashlib
import hmac
import json
import logging
import os
import shutil
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from device import atomic_io
from device.clock import Clock
from services.errors import StoreDamaged
from services.records.json_values import JsonObject, JsonValue

log = logging.getLogger(__name__)

LOG, HEAD = "audit-log.jsonl", "audit-head.json"
MAX_TEXT = 200
NEWEST_BYTES = 4_000_000  # about 13,000 entries: 0.3 s to list and check
TAIL_BYTES = 65_536  # longer than any entry
ARCHIVE_REMEDY = "Keep the whole log, and restore it from a backup if there is one."
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
    """Result of a check: number of valid entries among those checked, and what is wrong; None if all is as written."""

    entries: int
    problem: str | None


class AuditLog:
    """Audit log in the folder of a store; `key`: secret key of its digests, at least 32 bytes. Thread-safe, also with
    other processes.

    Entries continue after the number of the head, so that a gap stays visible after the log was cut or changed.
    """

    def __init__(self, folder: Path, key: bytes, clock: Clock) -> None:
        self._folder, self._key, self._clock = folder, key, clock
        self._lock = Lock()
        self._last, self._bytes = (0, ""), -1  # last entry of this process, and size of the file with it
        self._archived = (0, "")

    def append(self, user: str, action: str, record: str = "", **more: str) -> None:
        """Append one entry durably; OSError if the disk refuses."""
        with self._lock, atomic_io.file_lock(self._folder / LOG):
            number, before = self._last if self._bytes == audit_log_bytes(self._folder) else self._position()
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
            self._last, self._bytes = (number + 1, mac), audit_log_bytes(self._folder)
            atomic_io.write_atomically(self._folder / HEAD, _head(self._key, self._last, self._archived))

    def archive(self, target: Path) -> int:
        """Move all entries to the new file `target`, after which the chain goes on; return the number of the last one.

        For a log that no other process writes. StoreDamaged if the log is not as it was written; OSError.
        """
        found = self.check()
        if found.problem is not None:
            raise StoreDamaged(f"the audit log is not as it was written: {found.problem}", ARCHIVE_REMEDY)
        with self._lock, open(target, "xb", buffering=0, opener=atomic_io.private_opener) as copy:
            last = self._position()
            with open(self._folder / LOG, "rb") as file:
                shutil.copyfileobj(file, copy)
            atomic_io.fsync_file(target)
            atomic_io.write_atomically(self._folder / HEAD, _head(self._key, last, last))
            self._position()  # removes the entries that are archived
        return last[0]

    def entries(self, limit: int, user: str = "", action: str = "", record: str = "") -> list[AuditEntry]:
        """Return the last entries of a user, action or record ("" for all), the newest first; damaged ones not.

        Of the last NEWEST_BYTES: earlier ones are in the file, which `diffuscope audit verify` checks as a whole.
        """
        wanted = {"user": user, "action": action, "record": record}
        lines = (
            line
            for line in self._lines(NEWEST_BYTES)
            if line is not None and all(not text or line.get(name) == text for name, text in wanted.items())
        )
        return [_entry(line) for line in reversed(deque(lines, limit))]

    def check(self, newest_bytes: int | None = None) -> AuditFinding:
        """Check the chain of all entries, or of those in the last `newest_bytes` of the file, and the head."""
        with self._lock:  # an entry that is added meanwhile is not in this head
            size, head = audit_log_bytes(self._folder), self._head()
        lines = self._lines(newest_bytes, size)
        number, mac = (0, "") if head is None else head[1]
        if newest_bytes is not None and size > newest_bytes and (first := next(lines, None)):
            number, mac = int(str(first["number"])), str(first["mac"])
        begin = number
        for line in lines:
            if line is None:
                return AuditFinding(number - begin, f"the entry after number {number} cannot be read")
            if line.get("number") != number + 1 or not _is_authentic(self._key, mac, line):
                return AuditFinding(number - begin, f"the entry after number {number} was changed, moved or left out")
            number, mac = number + 1, str(line["mac"])
        if head is None:
            return AuditFinding(number - begin, "the head is missing or was changed")
        # A power cut may come between an entry and its head.
        if head[0] != (number, mac) and head[0][0] != number - 1:
            return AuditFinding(number - begin, f"there are {number} entries, and there were {head[0][0]}")
        return AuditFinding(number - begin, None)

    def _position(self) -> tuple[int, str]:
        """Return number and `mac` after which the next entry is chained: of the last entry, or of a later head.

        Remove a line that a power cut left incomplete, whose request was not answered, and entries that are archived.
        """
        path, last = self._folder / LOG, (0, "")
        if size := audit_log_bytes(self._folder):
            with open(path, "rb") as file:
                file.seek(max(0, size - TAIL_BYTES))
                tail = file.read()
            if b"\n" in tail or size <= TAIL_BYTES:
                os.truncate(path, size - len(tail) + tail.rfind(b"\n") + 1)
        for line in self._lines(TAIL_BYTES):
            last = last if line is None else (int(str(line["number"])), str(line["mac"]))
        if (head := self._head()) is not None:
            self._archived = head[1]
            if last[0] and last == head[0] == head[1]:
                os.truncate(path, 0)
            last = max(last, head[0], key=lambda position: position[0])
        return last

    def _lines(self, newest_bytes: int | None = None, size: int | None = None) -> Iterator[JsonObject | None]:
        """Yield the entries in the first `size` bytes, whole ones of the newest bytes; None for a line that is none."""
        end = audit_log_bytes(self._folder) if size is None else size
        if not end:
            return
        with open(self._folder / LOG, "rb") as file:
            if newest_bytes is not None and end > newest_bytes:
                file.seek(end - newest_bytes)
                file.readline()
            end -= file.tell()
            while end > 0 and (line := file.readline()):
                end -= len(line)
                yield _parsed(line)

    def _head(self) -> tuple[tuple[int, str], tuple[int, str]] | None:
        """Return number and `mac` of the last entry, and of the last archived one; None for no or a changed head."""
        try:
            head = json.loads((self._folder / HEAD).read_bytes())
            last, archived = ((int(number), str(mac)) for number, mac in (head["last"], head["archived"]))
            is_own = hmac.compare_digest(_head(self._key, last, archived), json.dumps(head).encode())
            return (last, archived) if is_own else None
        except (OSError, ValueError, KeyError, TypeError):
            return None


def audit_log_bytes(folder: Path) -> int:
    """Return the size of the audit log in the folder of a store, in bytes; 0 without one."""
    path = folder / LOG
    return path.stat().st_size if path.exists() else 0


def _line(entry: JsonObject) -> bytes:
    return json.dumps(entry).encode() + b"\n"


def _parsed(line: bytes) -> JsonObject | None:
    """Return the entry in a line; None if it is none."""
    try:
        entry: JsonValue = json.loads(line)
    except ValueError:
        return None
    is_whole = isinstance(entry, dict) and set(entry) == KEYS and isinstance(entry["number"], int)
    return entry if isinstance(entry, dict) and is_whole and _line(entry) == line else None


def _mac(key: bytes, before: str, entry: JsonObject) -> str:
    return hmac.new(key, f"{before}\n{json.dumps(entry, sort_keys=True)}".encode(), hashlib.sha256).hexdigest()


def _is_authentic(key: bytes, before: str, line: JsonObject) -> bool:
    entry = {name: value for name, value in line.items() if name != "mac"}
    return hmac.compare_digest(_mac(key, before, entry), str(line["mac"]))


def _head(key: bytes, last: tuple[int, str], archived: tuple[int, str]) -> bytes:
    head = {"last": last, "archived": archived}
    seal = hmac.new(key, f"head {json.dumps(head)}".encode(), hashlib.sha256).hexdigest()
    return json.dumps(head | {"seal": seal}).encode()


def _entry(line: JsonObject) -> AuditEntry:
    more = line["more"] if isinstance(line["more"], dict) else {}
    texts = {name: str(value) for name, value in more.items()}
    at, user, action, record = (str(line[name]) for name in ("at", "user", "action", "record"))
    return AuditEntry(int(str(line["number"])), at, user, action, record, texts)
