"""Removal of pictures of visits that were exported, or sent and confirmed, to make room; it can be undone."""

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime

from device.clock import Clock
from services.records.capture_store import CaptureStore
from services.records.export_records import ExportRecords
from services.records.removed_captures import Reason, Removal
from services.records.upload_queue import UploadQueue
from services.records.visit import Visit
from services.records.visit_repository import VisitRepository

MAX_VISITS = 100_000  # more than a card holds


def reason_to_remove(visit: Visit, sent: Collection[str], exported_state: datetime | None) -> Reason | None:
    """Return why the pictures of a visit may be removed; None if they may not.

    The visit is finished, and its present state was confirmed by the receiver (its id is in `sent`), or copied to
    a USB drive and read back (`exported_state` is its `finished_at`). A downloaded ZIP file cannot be verified and does
    not count. Neither copy has the raw frames: only a backup has.
    """
    if visit.finished_at is None:
        return None
    if visit.id in sent:
        return "sent"
    return "exported" if exported_state == visit.finished_at else None


@dataclass(frozen=True)
class Removable:
    """Captures that may be removed, by reason; number, size and local days (ISO 8601) of what that would remove."""

    captures: dict[Reason, list[str]]
    visits: int
    size_bytes: int
    oldest_day: str | None
    newest_day: str | None


class PictureRemoval:
    """Removes pictures of visits by the rule `reason_to_remove`, and undoes it as long as their space is not needed."""

    def __init__(self, store: CaptureStore, visits: VisitRepository, clock: Clock) -> None:
        self._store, self._visits, self._clock = store, visits, clock
        self._queue = UploadQueue(store.engine, clock)
        self._exports = ExportRecords(store.folder)

    def removable(self) -> Removable:
        """Return what may be removed now. StoreError if the database cannot be read."""
        sent = self._queue.sent_visits()
        found: dict[Reason, list[str]] = {"exported": [], "sent": []}
        days = list[str]()
        size_bytes = 0
        for visit in self._visits.visits(MAX_VISITS, open=False):
            reason = reason_to_remove(visit, sent, self._exports.exported_state(visit.id))
            ids = [taken.capture for slot in visit.slots.values() for taken in slot.captures]
            sizes = {id: size for id in ids if (size := self._store.removed.removable_bytes(id))}
            if reason is not None and sizes:
                found[reason] += sizes
                days.append(visit.day)
                size_bytes += sum(sizes.values())
        return Removable(found, len(days), size_bytes, min(days, default=None), max(days, default=None))

    def remove(self) -> None:
        """Remove what may be removed now; StoreError if the disk refuses, a repetition then goes on."""
        for reason, ids in self.removable().captures.items():
            self._store.removed.remove(ids, Removal(reason, self._clock.wall()))

    def undo(self) -> int:
        """Bring back everything whose space was not needed yet; return the number of captures."""
        return self._store.removed.undo()

    def undoable(self) -> tuple[int, int]:
        """Return number and size (bytes) of the captures that `undo` would bring back."""
        sizes = self._store.removed.sizes_bytes()
        return len(sizes), sum(sizes.values())
