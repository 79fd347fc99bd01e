"""Folders of captures without a row: quarantine of the incomplete ones, list of the complete ones (orphans)."""

import logging
from pathlib import Path

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from device import atomic_io
from services.records.schema import CaptureRow
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

REQUIRED_FILES = frozenset(
    {"raw.tiff", "picture.png", "quick.jpg", "report.json"}
)  # of a complete capture; a press that was interrupted may have no dark.tiff


class Quarantine:
    """Quarantine of incomplete captures in `quarantine/`; the writer of a capture holds the lock file `lock`."""

    def __init__(self, captures: Path, folder: Path, lock: Path, engine: Engine) -> None:
        self._captures, self._folder, self._lock, self._engine = captures, folder, lock, engine

    def sizes_bytes(self) -> dict[str, int]:
        """Return the size (bytes) of each incomplete capture in quarantine by name, oldest first.

        They are deleted if a new capture needs their space. Complete captures among them are orphans and not included.
        """
        folders = [folder for folder in sorted(self._folder.iterdir()) if not _is_complete(folder)]
        return {folder.name: atomic_io.size_bytes(folder) for folder in folders}

    def number_of_files(self) -> int:
        """Return the number of files and folders of the incomplete captures in quarantine."""
        return sum(atomic_io.number_of_files(self._folder / name) for name in self.sizes_bytes())

    def orphans(self) -> list[str]:
        """Return the sorted names of the complete capture folders without a row, which the store never removes.

        Complete folders in quarantine, which had all files but not yet their name, are included. Lists of captures omit
        orphans.
        """
        with storage_errors(), atomic_io.file_lock(self._lock):  # a capture that is being written gets its row first
            folders = [*self.folders_without_row(), *self._folder.iterdir()]
            return sorted(folder.name for folder in folders if _is_complete(folder))

    def folders_without_row(self) -> list[Path]:
        """Return every folder in `captures/` whose name has no row, also `.part` folders; sorted."""
        with Session(self._engine) as session:
            kept = set(session.scalars(select(CaptureRow.id)))
        return sorted(path for path in self._captures.iterdir() if path.is_dir() and path.name not in kept)

    def move_incomplete(self) -> tuple[str, ...]:
        """Move each folder without a row that is a `.part` folder or lacks a required file to `quarantine/`.

        Return the names there. Complete folders without a row stay.
        """
        incomplete = [
            stray for stray in self.folders_without_row() if stray.name.startswith(".") or not _is_complete(stray)
        ]
        moved = tuple(atomic_io.quarantine(stray, self._folder) for stray in incomplete)
        if moved:
            atomic_io.fsync_folder(self._folder)
            atomic_io.fsync_folder(self._captures)
        return moved

    def delete(self, name: str) -> None:
        """Delete a quarantined capture, because a new capture needs its space."""
        atomic_io.remove(self._folder / name)
        log.warning("quarantined capture %s deleted: a new capture needs its space", name)


def _is_complete(folder: Path) -> bool:
    return folder.is_dir() and {path.name for path in folder.iterdir()} >= REQUIRED_FILES
