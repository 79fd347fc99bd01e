"""Second copy of the dose ledger beside the database, so that lost rows or a restored older database lower no dose.

    light.copy      two blocks of BLOCK_BYTES, written alternately: length (u32 LE), CRC-32 (u32 LE), JSON

The block with the highest `number` among those with a valid CRC is used. The older block is overwritten after each
commit without fsync, so that no exposure waits for it: only the database is durable across a power cut. The copy is
read at each opening of the ledger, because the database may have lost rows or may be a restored snapshot.
"""

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

from device.light_safety.dose_ledger import DoseLedgerState
from device.values import EYES

BLOCK_BYTES = 32_768  # two eyes, a day of slots of ten minutes, 60 bytes each: 18,000
_HEAD = struct.Struct("<II")


class DoseCopy:
    """Second copy of the dose ledger, in one file; the caller must ensure that only one thread or process writes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._number = max((number for number, _ in self._blocks()), default=0)

    def raise_to_copy(self, state: DoseLedgerState) -> None:
        """Raise each dose (J/cm2) and the observed time (s) in `state`, in place, to at least the copy's value.

        With the observed time, `boot` and `now_s` are those of the copy. No effect without a valid block.
        """
        newest = max(self._blocks(), key=lambda block: block[0], default=None)
        if newest is None:
            return
        copy = newest[1]
        if copy.observed_s > state.observed_s:
            state.observed_s, state.boot, state.now_s = copy.observed_s, copy.boot, copy.now_s
        for key, dose_j_per_cm2 in copy.doses.items():
            state.doses[key] = max(state.doses.get(key, 0.0), dose_j_per_cm2)

    def write(self, state: DoseLedgerState) -> None:
        """Write `state` over the older block, without fsync; OSError if the disk refuses."""
        self._number += 1
        doses = [[eye, slot, dose_j_per_cm2] for (eye, slot), dose_j_per_cm2 in state.doses.items()]
        time = {"boot": state.boot, "now_s": state.now_s, "observed_s": state.observed_s}
        content = json.dumps({"number": self._number, **time, "doses": doses}).encode()
        block = _HEAD.pack(len(content), zlib.crc32(content)) + content
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.pwrite(descriptor, block.ljust(BLOCK_BYTES, b"\0"), self._number % 2 * BLOCK_BYTES)
        finally:
            os.close(descriptor)

    def _blocks(self) -> list[tuple[int, DoseLedgerState]]:
        """Return number and state of each block with a valid CRC."""
        file = self._path.read_bytes() if self._path.exists() else b""
        blocks = (file[start : start + BLOCK_BYTES] for start in (0, BLOCK_BYTES))
        return [found for block in blocks if (found := _read(block)) is not None]


def _read(block: bytes) -> tuple[int, DoseLedgerState] | None:
    """Return number and state of a block; None if it is empty or incomplete, or if its CRC does not match."""
    if len(block) < _HEAD.size:
        return None
    length, crc = _HEAD.unpack_from(block)
    content = block[_HEAD.size : _HEAD.size + length]
    if not content or len(content) != length or zlib.crc32(content) != crc:
        return None
    entry: dict[str, Any] = json.loads(content)
    doses = {(eye, slot): dose for eye, slot, dose in entry["doses"] if eye in EYES}
    return entry["number"], DoseLedgerState(doses, entry["observed_s"], entry["boot"], entry["now_s"])
