"""A second copy of the dose ledger beside the database, so that a damaged log or an older database lowers no dose.

    light.copy      two blocks of BLOCK_BYTES, written alternately: length (u32 LE), CRC-32 (u32 LE), JSON

The block with the highest `number` among those with a valid CRC is used. The file is overwritten after each commit
without fsync: only the database is durable across a power cut. The operating system writes the copy within seconds; no
exposure waits for it. It is read where the database may have lost rows.
"""

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

from device.ledger import Page
from device.values import EYES

BLOCK_BYTES = 32_768  # two eyes, a day of slots of ten minutes, 60 bytes each: 18,000
_HEAD = struct.Struct("<II")


class DoseCopy:
    """The copy in one file; the caller takes care that one process writes at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._number = max((number for number, _ in self._blocks()), default=0)

    def higher(self, page: Page) -> None:
        """Raise each dose (J/cm2) and the observed time (s) in `page`, in place, to at least the copy's value.

        No effect without a valid block.
        """
        newest = max(self._blocks(), key=lambda block: block[0], default=None)
        if newest is None:
            return
        copy = newest[1]
        if copy.observed_s > page.observed_s:
            page.observed_s, page.boot, page.now_s = copy.observed_s, copy.boot, copy.now_s
        for key, dose_j_per_cm2 in copy.doses.items():
            page.doses[key] = max(page.doses.get(key, 0.0), dose_j_per_cm2)

    def write(self, page: Page) -> None:
        """Write the newest state over the older block; OSError if the disk refuses."""
        self._number += 1
        doses = [[eye, slot, dose_j_per_cm2] for (eye, slot), dose_j_per_cm2 in page.doses.items()]
        time = {"boot": page.boot, "now_s": page.now_s, "observed_s": page.observed_s}
        content = json.dumps({"number": self._number, **time, "doses": doses}).encode()
        block = _HEAD.pack(len(content), zlib.crc32(content)) + content
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.pwrite(descriptor, block.ljust(BLOCK_BYTES, b"\0"), self._number % 2 * BLOCK_BYTES)
        finally:
            os.close(descriptor)

    def _blocks(self) -> list[tuple[int, Page]]:
        """Return number and state of each block with a valid CRC."""
        file = self._path.read_bytes() if self._path.exists() else b""
        blocks = (file[start : start + BLOCK_BYTES] for start in (0, BLOCK_BYTES))
        return [found for block in blocks if (found := _read(block)) is not None]


def _read(block: bytes) -> tuple[int, Page] | None:
    """Number and state; None of a block that was never written, or was changed since."""
    if len(block) < _HEAD.size:
        return None
    length, crc = _HEAD.unpack_from(block)
    content = block[_HEAD.size : _HEAD.size + length]
    if not content or len(content) != length or zlib.crc32(content) != crc:
        return None
    said: dict[str, Any] = json.loads(content)
    doses = {(eye, slot): dose for eye, slot, dose in said["doses"] if eye in EYES}
    return said["number"], Page(doses, said["observed_s"], said["boot"], said["now_s"])
