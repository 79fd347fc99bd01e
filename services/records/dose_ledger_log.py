"""Second copy of the dose ledger: an append-only file, so that lost or restored rows of the database lower no dose.

    dose-ledger.log     one line per change: CRC-32 (8 hexadecimal digits), space, JSON of the whole ledger
    light.copy          two blocks of an earlier release, read while there is no line yet, removed after the first one

Each line holds the whole ledger, so the last line with a valid CRC is enough. Lines are appended without fsync, so that
no exposure waits for it: only the database is durable across a power cut. A log of MAX_BYTES is replaced atomically by
its last line.
"""

import json
import struct
import zlib
from pathlib import Path

from device import atomic_io
from device.light_safety.dose_ledger import DoseLedgerState
from device.values import EYES, Eye
from services.records.json_values import JsonObject, JsonValue
from services.records.record_document import as_number, as_object, whole_number
from services.records.row_validation import one_of, text

LOG, EARLIER_COPY = "dose-ledger.log", "light.copy"
MAX_BYTES = 262_144
EARLIER_BLOCK_BYTES = 32_768
_EARLIER_HEAD = struct.Struct("<II")  # length and CRC-32 of the JSON that follows


class DoseLedgerLog:
    """Append-only copy of the dose ledger in the folder of the store; the caller serialises writers."""

    def __init__(self, folder: Path) -> None:
        self._path, self._earlier = folder / LOG, folder / EARLIER_COPY

    def newest(self) -> DoseLedgerState | None:
        """Return the last ledger with a valid CRC, of an earlier release without a line; None if there is none."""
        lines = self._path.read_bytes().splitlines() if self._path.exists() else []
        for line in reversed(lines):
            if (state := _state_in(line)) is not None:
                return state
        return self._newest_of_earlier_release()

    def append(self, state: DoseLedgerState) -> None:
        """Append a ledger, without fsync, and remove the copy of an earlier release; OSError if the disk refuses."""
        line = _line(state)
        if self._path.exists() and self._path.stat().st_size + len(line) > MAX_BYTES:
            atomic_io.write_atomically(self._path, line)
            return
        with open(self._path, "ab", buffering=0, opener=atomic_io.private_opener) as file:
            file.write(line)
        # Outdated from now on: with table and log gone, it would be used instead of counting both eyes as full.
        self._earlier.unlink(missing_ok=True)

    def _newest_of_earlier_release(self) -> DoseLedgerState | None:
        file = self._earlier.read_bytes() if self._earlier.exists() else b""
        blocks = (file[start : start + EARLIER_BLOCK_BYTES] for start in (0, EARLIER_BLOCK_BYTES))
        found = [one for block in blocks if (one := _block(block)) is not None]
        return max(found, key=lambda one: one[0])[1] if found else None


def raise_to(state: DoseLedgerState, other: DoseLedgerState) -> None:
    """Raise each dose (J/cm2) and the observed time (s) in `state`, in place, to at least the value in `other`.

    With the observed time, `boot` and `now_s` are those of `other`.
    """
    if other.observed_s > state.observed_s:
        state.observed_s, state.boot, state.now_s = other.observed_s, other.boot, other.now_s
    for key, dose_j_per_cm2 in other.doses.items():
        state.doses[key] = max(state.doses.get(key, 0.0), dose_j_per_cm2)


def _line(state: DoseLedgerState) -> bytes:
    """Return the line of a ledger, after a line break: a torn line before it stays a line of its own."""
    doses = [[eye, slot, dose_j_per_cm2] for (eye, slot), dose_j_per_cm2 in state.doses.items()]
    entry = {"boot": state.boot, "now_s": state.now_s, "observed_s": state.observed_s, "doses": doses}
    content = json.dumps(entry, separators=(",", ":")).encode()
    return b"\n%08x %b\n" % (zlib.crc32(content), content)


def _state_in(line: bytes) -> DoseLedgerState | None:
    """Return the ledger in a line; None if the line is torn, or if its CRC does not match."""
    crc, _, content = line.partition(b" ")
    if not content or crc != b"%08x" % zlib.crc32(content):
        return None
    return _ledger(as_object(json.loads(content)))


def _block(block: bytes) -> tuple[int, DoseLedgerState] | None:
    """Return number and ledger of a block of an earlier release; None if its CRC does not match."""
    if len(block) < _EARLIER_HEAD.size:
        return None
    length, crc = _EARLIER_HEAD.unpack_from(block)
    content = block[_EARLIER_HEAD.size : _EARLIER_HEAD.size + length]
    if not content or len(content) != length or zlib.crc32(content) != crc:
        return None
    entry = as_object(json.loads(content))
    return whole_number(entry["number"]), _ledger(entry)


def _ledger(entry: JsonObject) -> DoseLedgerState:
    observed_s, now_s = (as_number(entry[name]) for name in ("observed_s", "now_s"))
    doses = entry["doses"] if isinstance(entry["doses"], list) else []
    return DoseLedgerState(dict(map(_dose, doses)), observed_s, text(entry["boot"]), now_s)


def _dose(entry: JsonValue) -> tuple[tuple[Eye, int], float]:
    """Return eye and slot, and the dose (J/cm2), of an entry of `doses`."""
    if not isinstance(entry, list):
        raise ValueError(f"{type(entry).__name__} where a dose was kept")
    eye, slot, dose_j_per_cm2 = entry
    return (one_of(eye, *EYES), whole_number(slot)), as_number(dose_j_per_cm2)
