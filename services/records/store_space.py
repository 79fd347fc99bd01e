"""Free space of the store, counted in captures and in visits, and room for a new capture."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from sqlalchemy import Engine, distinct, func, select
from sqlalchemy.orm import Session

from device import atomic_io
from device.errors import StoreFull
from services.records.schema import VISIT_ROWID, CaptureSlotRow, FileRow, VisitRow
from services.records.storage_errors import storage_errors

RECENT_VISITS = 100  # visits whose mean size predicts the size of the next ones
DEFAULT_CAPTURE_BYTES = 10_000_000  # size of the first capture: 4 megapixels of raw, compressed, and a picture


class Deletable(Protocol):
    """Content that is kept until its space is needed."""

    def sizes_bytes(self) -> Mapping[str, int]:
        """Return the size (bytes) of each item by name, in the order of deletion."""

    def delete(self, name: str) -> None:
        """Delete one item."""


class StoreSpace:
    """Free space of the store in `folder`; `reserve_bytes` stay free, and what `deletable` holds counts as free space.

    `deletable`: removed files and quarantined captures, in the order of their deletion. `free_bytes` returns the free
    space of a folder's file system.
    """

    def __init__(
        self,
        folder: Path,
        engine: Engine,
        deletable: Sequence[Deletable],
        reserve_bytes: int,
        free_bytes: Callable[[Path], int],
    ) -> None:
        self._folder, self._engine, self._deletable = folder, engine, deletable
        self._reserve_bytes, self._free_bytes = reserve_bytes, free_bytes
        self._sizes: tuple[int, int] | None = None  # bytes and captures; cached, because each status request needs them

    def captures_left(self) -> int:
        """Return the number of further captures that fit on the disk, from the mean size of the stored captures."""
        if self._sizes is None:
            every = select(func.coalesce(func.sum(FileRow.bytes), 0), func.count(distinct(FileRow.capture_id)))
            with storage_errors(), Session(self._engine) as session:
                total_bytes, number = session.execute(every).one()
            self._sizes = total_bytes, number
        total_bytes, number = self._sizes
        mean_bytes = max(1, total_bytes // number) if number else DEFAULT_CAPTURE_BYTES
        return self._usable_bytes() // mean_bytes

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
        return self._usable_bytes() * number // total_bytes if total_bytes else self.captures_left() // pictures

    def refuse_without_room(self) -> None:
        """Raise StoreFull if not even one more capture fits."""
        if self.captures_left() == 0:
            raise StoreFull(f"{self._free_bytes(self._folder)} bytes are free, too few for a capture")

    def count_capture(self, length_bytes: int) -> None:
        """Count one more stored capture of that length."""
        if self._sizes is not None:
            self._sizes = self._sizes[0] + length_bytes, self._sizes[1] + 1

    def make_room(self, need_bytes: int) -> None:
        """Delete removed files, then quarantined captures, oldest first, until `need_bytes` and the reserve fit.

        StoreFull if they still do not.
        """
        deletable = ((place, name) for place in self._deletable for name in place.sizes_bytes())
        while not atomic_io.has_room(need_bytes, free := self._free_bytes(self._folder), self._reserve_bytes):
            if (oldest := next(deletable, None)) is None:
                required = f"{need_bytes} and a reserve of {self._reserve_bytes} are needed"
                raise StoreFull(f"{free} bytes are free; {required}")
            place, name = oldest
            place.delete(name)

    def _usable_bytes(self) -> int:
        deletable_bytes = sum(sum(place.sizes_bytes().values()) for place in self._deletable)
        return max(0, self._free_bytes(self._folder) + deletable_bytes - self._reserve_bytes)
