"""Free space of the store, counted in captures and in visits, and room for a new capture.

A file system is full without free bytes, and without free files (inodes): the scarcer of the two counts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sqlalchemy import Engine, distinct, func, select
from sqlalchemy.orm import Session

from device import atomic_io
from device.errors import StoreFull
from services.errors import NO_FILES_REMEDY
from services.records.schema import VISIT_ROWID, CaptureSlotRow, FileRow, VisitRow
from services.records.storage_errors import storage_errors

RECENT_VISITS = 100  # visits whose mean size predicts the size of the next ones
DEFAULT_CAPTURE_BYTES = 10_000_000  # size of the first capture: 4 megapixels of raw, compressed, and a picture
DEFAULT_CAPTURE_FILES = 12  # files and folders of the first capture: those of a burst
RESERVE_FILES = 16  # stay free, for the answers of a visit, the logs of the database and of the light, and the trial


class Deletable(Protocol):
    """Content that is kept until its space is needed."""

    def sizes_bytes(self) -> Mapping[str, int]:
        """Return the size (bytes) of each item by name, in the order of deletion."""

    def number_of_files(self) -> int:
        """Return the number of files and folders of all items."""

    def delete(self, name: str) -> None:
        """Delete one item."""


@dataclass(frozen=True)
class FreeSpace:
    """Free space of the file system of `folder`, in bytes and in files; each function is called with the folder."""

    folder: Path
    free_bytes: Callable[[Path], int]
    free_files: Callable[[Path], float]

    @property
    def in_bytes(self) -> int:
        """Free bytes."""
        return self.free_bytes(self.folder)

    @property
    def in_files(self) -> float:
        """Number of files and folders that can still be made; infinity where they are not counted."""
        return self.free_files(self.folder)


@dataclass
class _Stored:
    """Total size of the stored captures, their number, and the number of their files."""

    total_bytes: int
    captures: int
    files: int

    @property
    def mean_bytes(self) -> int:
        return max(1, self.total_bytes // self.captures) if self.captures else DEFAULT_CAPTURE_BYTES

    @property
    def mean_files(self) -> int:
        """Mean number of files and folders of a capture, with its record."""
        return math.ceil(self.files / self.captures) + 2 if self.captures else DEFAULT_CAPTURE_FILES


class StoreSpace:
    """Free space of the store; `reserve_bytes` stay free, and what `deletable` holds counts as free space.

    `deletable`: removed files and quarantined captures, in the order of their deletion.
    """

    def __init__(self, free: FreeSpace, engine: Engine, deletable: Sequence[Deletable], reserve_bytes: int) -> None:
        self._free, self._engine, self._deletable, self._reserve_bytes = free, engine, deletable, reserve_bytes
        self._cached: _Stored | None = None  # each status request needs it

    def captures_left(self) -> int:
        """Return the number of further captures that fit on the disk, from the mean size of the stored captures."""
        return int(min(self._usable_bytes() // self._stored().mean_bytes, self._captures_by_files()))

    def lacks_files(self) -> bool:
        """Return whether the free files, and not the free bytes, limit the number of further captures."""
        return self._captures_by_files() < self._usable_bytes() // self._stored().mean_bytes

    def visits_left(self, pictures: int) -> int:
        """Return the number of further visits that fit on the disk, from the mean size of the last 100 finished visits.

        Without captures in them: `captures_left` divided by `pictures`, the number of captures per visit.
        """
        lately = select(VisitRow.id).where(VisitRow.finished_at.is_not(None)).order_by(VISIT_ROWID.desc())
        sizes = (
            select(func.coalesce(func.sum(FileRow.bytes), 0), func.count(distinct(CaptureSlotRow.visit)))
            .join(CaptureSlotRow, CaptureSlotRow.capture == FileRow.capture_id)
            .where(CaptureSlotRow.visit.in_(lately.limit(RECENT_VISITS)))
        )
        with storage_errors(), Session(self._engine) as session:
            total_bytes, number = session.execute(sizes).one()
        if not total_bytes:
            return self.captures_left() // pictures
        return int(min(self._usable_bytes() * number // total_bytes, self._captures_by_files() // pictures))

    def refuse_without_room(self) -> None:
        """Raise StoreFull if not even one more capture fits."""
        if self._captures_by_files() == 0:
            raise StoreFull("the disk takes too few more files for a capture", NO_FILES_REMEDY)
        if self.captures_left() == 0:
            raise StoreFull(f"{self._free.in_bytes} bytes are free, too few for a capture")

    def press_files(self) -> int:
        """Return the number of files of a press: its frames in the journal, the stored capture, and the reserve."""
        return RESERVE_FILES + 2 * self._stored().mean_files

    def must_delete_files(self) -> bool:
        """Return whether a press would have to wait for the deletion of files: fewer are free than it writes."""
        return self._free.in_files < self.press_files()

    def count_capture(self, length_bytes: int, files: int) -> None:
        """Count one more stored capture of that length and that number of files."""
        if (stored := self._cached) is not None:
            self._cached = _Stored(stored.total_bytes + length_bytes, stored.captures + 1, stored.files + files)

    def make_room(self, need_bytes: int, need_files: int) -> None:
        """Delete removed files, then quarantined captures, oldest first, until a capture and the reserve fit.

        `need_bytes`, `need_files`: what the capture needs. StoreFull if it still does not fit.
        """
        deletable = ((place, name) for place in self._deletable for name in place.sizes_bytes())
        while (refusal := self._refusal(need_bytes, need_files)) is not None:
            if (oldest := next(deletable, None)) is None:
                raise refusal
            place, name = oldest
            place.delete(name)

    def _refusal(self, need_bytes: int, need_files: int) -> StoreFull | None:
        free = self._free.in_bytes
        if not atomic_io.has_room(need_bytes, free, self._reserve_bytes):
            required = f"{need_bytes} and a reserve of {self._reserve_bytes} are needed"
            return StoreFull(f"{free} bytes are free; {required}")
        if self._free.in_files < need_files:
            return StoreFull(f"the disk takes fewer than {need_files} more files", NO_FILES_REMEDY)
        return None

    def _stored(self) -> _Stored:
        if self._cached is None:
            every = select(
                func.coalesce(func.sum(FileRow.bytes), 0), func.count(distinct(FileRow.capture_id)), func.count()
            ).select_from(FileRow)
            with storage_errors(), Session(self._engine) as session:
                self._cached = _Stored(*session.execute(every).one())
        return self._cached

    def _usable_bytes(self) -> int:
        deletable_bytes = sum(sum(place.sizes_bytes().values()) for place in self._deletable)
        return max(0, self._free.in_bytes + deletable_bytes - self._reserve_bytes)

    def _captures_by_files(self) -> float:
        """Return the number of captures whose files fit, beside the reserve and the frames of one in progress."""
        each = self._stored().mean_files
        usable = self._free.in_files + sum(place.number_of_files() for place in self._deletable)
        return max(0, (usable - self.press_files()) // each + 1) if math.isfinite(usable) else usable
