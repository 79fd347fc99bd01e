"""Second copy of the dose ledger: an append-only file, so that lost or restored rows of the database lower no dose.

    dose-ledger.log     one line per change: CRC-32 (8 hexadecimal digits), space, JSON of the whole ledger and `mac`

Each line holds the whole ledger, so the last valid line is enough. `mac` is an HMAC-SHA-256 with the key of the store:
who changes a line can compute its CRC, but not that. Lines are appended without fsync, so that
no exposure waits for it: only the database is durable across a power cut. A log of MAX_BYTES is replaced atomically by
its last line.
"""

import hashlib
import hmac
import json
import zlib
from pathlib import Path

from device import atomic_io
from device.light_safety.dose_ledger import DoseLedgerState
from device.values import EYES, Eye
from services.records.json_values import JsonObject, JsonValue
from services.records.record_document import as_number, as_object, whole_number
from services.records.row_validation import one_of, text

LOG = "dose-ledger.log"
MAX_BYTES = 262_144


class DoseLedgerLog:
    """Append-only copy of the dose ledger in the folder of the store; the caller serialises writers.

    `key`: of the store; None writes and checks no `mac`.
    """

    def __init__(self, folder: Path, key: bytes | None = None) -> None:
        self._path, self._key = folder / LOG, key

    def newest(self) -> DoseLedgerState | None:
        """Return the last ledger with a valid CRC and `mac`; None if there is none."""
        lines = self._path.read_bytes().splitlines() if self._path.exists() else []
        for line in reversed(lines):
            if (state := _state_in(line, self._key)) is not None:
                return state
        return None

    def append(self, state: DoseLedgerState) -> None:
        """Append a ledger, without fsync; OSError if the disk refuses."""
        line = _line(state, self._key)
        if self._path.exists() and self._path.stat().st_size + len(line) > MAX_BYTES:
            atomic_io.write_atomically(self._path, line)
            return
        with open(self._path, "ab", buffering=0, opener=atomic_io.private_opener) as file:
            file.write(line)


def raise_doses(state: DoseLedgerState, other: DoseLedgerState) -> None:
    """Raise each dose (J/cm2) in `state`, in place, to at least the value in `other`."""
    for key, dose_j_per_cm2 in other.doses.items():
        state.doses[key] = max(state.doses.get(key, 0.0), dose_j_per_cm2)


def _line(state: DoseLedgerState, key: bytes | None) -> bytes:
    """Return the line of a ledger, after a line break: a torn line before it stays a line of its own."""
    doses: list[JsonValue] = [
        [eye, interval, dose_j_per_cm2] for (eye, interval), dose_j_per_cm2 in state.doses.items()
    ]
    entry: dict[str, JsonValue] = {"boot": state.boot, "now_s": state.now_s, "observed_s": state.observed_s}
    entry["doses"] = doses
    if key is not None:
        entry["mac"] = _mac(key, entry)
    content = json.dumps(entry, separators=(",", ":")).encode()
    return b"\n%08x %b\n" % (zlib.crc32(content), content)


def _mac(key: bytes, entry: JsonObject) -> str:
    return hmac.new(key, b"dose " + json.dumps(entry).encode(), hashlib.sha256).hexdigest()


def _state_in(line: bytes, key: bytes | None) -> DoseLedgerState | None:
    """Return the ledger in a line; None if the line is torn, or if its CRC or `mac` does not match."""
    crc, _, content = line.partition(b" ")
    if not content or crc != b"%08x" % zlib.crc32(content):
        return None
    entry = dict(as_object(json.loads(content)))
    mac = str(entry.pop("mac", ""))
    if key is not None and not hmac.compare_digest(_mac(key, entry), mac):
        return None
    return _ledger(entry)


def _ledger(entry: JsonObject) -> DoseLedgerState:
    observed_s, now_s = (as_number(entry[name]) for name in ("observed_s", "now_s"))
    doses = entry["doses"] if isinstance(entry["doses"], list) else []
    return DoseLedgerState(dict(map(_dose, doses)), observed_s, text(entry["boot"]), now_s)


def _dose(entry: JsonValue) -> tuple[tuple[Eye, int], float]:
    """Return eye and interval, and the dose (J/cm2), of an entry of `doses`."""
    if not isinstance(entry, list):
        raise ValueError(f"{type(entry).__name__} where a dose was kept")
    eye, interval, dose_j_per_cm2 = entry
    return (one_of(eye, *EYES), whole_number(interval)), as_number(dose_j_per_cm2)
