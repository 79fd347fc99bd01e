"""Removal of large files of captures whose visit was exported or sent; it can be undone until their space is needed.

    captures/<id>/removed.json    why and when the files were removed; report and thumbnails stay
    removed/<n>-<id>/             the files, the oldest removal first, until a new capture needs their space

The mark is written before the first file is moved and deleted after the last one is back, and a reader looks for a file
before it looks for the mark: after a power cut each file is in one of the two places, and a repetition completes the
removal or its undoing. No clock is involved in the end of the undo period.
"""

import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal, get_args

from device import atomic_io
from device.user_files import files_in
from services.errors import StoreDamaged
from services.records import digested_json, row_validation
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

LARGE_FILE = re.compile(
    r"(raw(-([0-9]+|[a-z]+))?|dark)[.]tiff|(picture|colour)(-[0-9]+)?[.]png"
)  # nearly all bytes of a capture
MARK = "removed.json"
Reason = Literal["exported", "sent"]


@dataclass(frozen=True)
class Removal:
    """Why and when the files of a capture were removed."""

    reason: Reason
    removed_at: datetime


def is_large(name: str) -> bool:
    """Return whether a file of a capture with this name is removed to free space."""
    return LARGE_FILE.fullmatch(name) is not None


class RemovedCaptures:
    """Removed files of the captures in the folder `captures`; a lock file `lock` serialises writers."""

    def __init__(self, captures: Path, folder: Path, lock: Path) -> None:
        self._captures, self._folder, self._lock = captures, folder, lock

    def removal(self, id: str) -> Removal | None:
        """Return the removal of a capture; None without one, StoreDamaged if its mark cannot be read."""
        path = self._captures / id / MARK
        if not path.exists():
            return None
        try:
            entries = digested_json.decoded(path.read_bytes())
            reason: Reason = row_validation.one_of(entries["reason"], *get_args(Reason))
            return Removal(reason, row_validation.timestamp(entries["removed_at"]))
        except (OSError, ValueError, KeyError) as error:
            raise StoreDamaged(f"the mark of the removal of {id} cannot be read: {error}") from error

    def removable_bytes(self, id: str) -> int:
        """Return the size (bytes) of the large files of a capture that are still in its folder."""
        return sum(path.stat().st_size for path in self._large_files(id))

    def _large_files(self, id: str) -> list[Path]:
        """Return the large files that are still in the folder of a capture, sorted; empty without a folder."""
        return sorted(path for path in (self._captures / id).glob("*") if is_large(path.name) and path.is_file())

    def remove(self, ids: Iterable[str], removal: Removal) -> None:
        """Move the large files of captures aside; no-op for a capture without them. StoreError if the disk refuses."""
        with storage_errors(), atomic_io.file_lock(self._lock):
            for id in ids:
                present = self._large_files(id)
                if not present:
                    continue
                mark = {"reason": removal.reason, "removed_at": removal.removed_at.isoformat()}
                atomic_io.write_atomically(self._captures / id / MARK, digested_json.encoded(mark))
                aside = self._aside(id) or self._folder / f"{self._next_number():06}-{id}"
                atomic_io.make_folder(aside)
                for path in present:
                    atomic_io.replace_durably(path, aside / path.name)

    def undo(self) -> int:
        """Move all files back whose space was not needed; return the number of captures. StoreError on failure."""
        with storage_errors(), atomic_io.file_lock(self._lock):
            folders = self._folders()
            for aside in folders:
                home = self._captures / aside.name.partition("-")[2]
                for path in sorted(aside.iterdir()):
                    atomic_io.replace_durably(path, home / path.name)
                (home / MARK).unlink(missing_ok=True)
                atomic_io.fsync_folder(home)
                aside.rmdir()
            return len(folders)

    def sizes_bytes(self) -> dict[str, int]:
        """Return the size (bytes) of what can still be undone, by name, the oldest removal first."""
        return {folder.name: atomic_io.size_bytes(folder) for folder in self._folders()}

    def number_of_files(self) -> int:
        """Return the number of files and folders of what can still be undone."""
        return sum(map(atomic_io.number_of_files, self._folders()))

    def delete(self, name: str) -> None:
        """Delete removed files, because a new capture needs their space; the caller holds the lock."""
        gone = self._folder / f".{name}"
        atomic_io.replace_durably(self._folder / name, gone)  # at once: what is left of a folder must not be undone
        atomic_io.remove(gone)
        log.info("the removed files of %s are deleted: a new capture needs their space", name)

    def _folders(self) -> list[Path]:
        if not self._folder.is_dir():
            return []
        return files_in(self._folder)

    def _aside(self, id: str) -> Path | None:
        return next((path for path in self._folders() if path.name.partition("-")[2] == id), None)

    def _next_number(self) -> int:
        return max((int(path.name.partition("-")[0]) for path in self._folders()), default=0) + 1
