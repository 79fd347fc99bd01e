"""Background upload of finished visits while the instrument is idle, with exponential backoff and jitter.

A thread polls the queue once per second and uploads one visit at a time. The thread writes only to the upload queue.
A visit with a permanent error is a dead letter: the visit stays in the queue and is retried only on request.
"""

import logging
import random
from collections.abc import Callable
from dataclasses import dataclass

from device.clock import Clock
from device.errors import DiffuscopeError
from services.delivery.uploader import Uploader, VisitArchive
from services.delivery.visit_export import folder_name, uploaded_files, zip_archive
from services.errors import (
    Busy,
    ReceiverUnreachable,
    ReceiverUntrusted,
    RecordNotFound,
    StoreDamaged,
    UploadMismatch,
    UploadRejected,
    UploadUnauthorised,
)
from services.periodic_worker import PeriodicWorker
from services.records.capture_store import CaptureStore
from services.records.upload_queue import QueuedVisit, UploadQueue
from services.records.visit_repository import VisitRepository

log = logging.getLogger(__name__)

POLL_S, CLOSE_TIMEOUT_S = 1.0, 5.0
BACKOFF_FIRST_S, BACKOFF_MAX_S = 60.0, 3600.0  # backoff between attempts, doubled each time
MAX_DOUBLINGS = 10  # avoids overflow of the power
JITTER = 0.2  # share of the backoff that is random: after a power cut, devices of a district must not retry at once
PAUSE_POLL_S = 0.1
MAX_PAUSE_S = 20.0  # receivers close a connection that is silent for longer
PERMANENT_ERRORS = (UploadRejected, UploadMismatch, StoreDamaged, RecordNotFound)  # permanent errors of one visit
DEAD_LETTER_CODES = frozenset(kind.code for kind in PERMANENT_ERRORS)


@dataclass(frozen=True)
class UploadCounts:
    """Numbers of visits: today's that were uploaded (`sent`), and all in the queue (`waiting`)."""

    sent: int
    waiting: int


class UploadWorker:
    """Worker thread of the upload queue; `is_idle` returns whether no exam needs the instrument.

    `build_archive` returns the archive of a visit id; `random_share` returns a number from 0 to 1 for the jitter.
    """

    def __init__(
        self,
        queue: UploadQueue,
        build_archive: Callable[[str], VisitArchive],
        uploader: Uploader,
        is_idle: Callable[[], bool],
        clock: Clock,
        random_share: Callable[[], float] = random.random,
    ) -> None:
        self.queue = queue
        self._build_archive, self._uploader, self._is_idle, self._clock, self._random = (
            build_archive,
            uploader,
            is_idle,
            clock,
            random_share,
        )
        self._failures = 0
        self._due_s = 0.0
        self._worker = PeriodicWorker("sending", self.step, POLL_S, "upload queue not readable")

    def begin(self) -> None:
        """Start the worker thread."""
        self._worker.begin()

    def close(self) -> None:
        """Stop the worker thread, waiting at most 5 s; an upload in progress is aborted, without a recorded failure."""
        self._worker.closing.set()
        self._uploader.abort()
        self._worker.close(timeout_s=CLOSE_TIMEOUT_S)

    def retry_now(self, visit: str | None = None) -> None:
        """Clear the errors of one visit (None: of all), reset the backoff and try at once."""
        self.queue.clear_errors(visit)
        self._failures = 0
        self._due_s = 0.0
        self._worker.wake()

    @property
    def backoff_s(self) -> float:
        """Return the remaining backoff in s; 0 if the next attempt is due."""
        return max(0.0, self._due_s - self._clock.now_s())

    def counts(self) -> UploadCounts:
        """Return the counts of today's uploaded visits and of the queue."""
        today = self._clock.wall().astimezone().date().isoformat()
        return UploadCounts(self.queue.uploaded_count(today), self.queue.status().waiting)

    def waiting_and_stuck(self) -> tuple[int, int]:
        """Return the number of visits in the queue, and how many of them are stuck and need help from a user.

        If the worker thread has ended unexpectedly, all of them need help.
        """
        status = self.queue.status()
        return status.waiting, status.waiting if self._worker.has_failed else status.stuck

    def step(self) -> bool:
        """Upload the visit with the earliest finish that is no dead letter, if an attempt is due and `is_idle`.

        Return whether an attempt succeeded or failed; False also after Busy. Upload errors are recorded in the queue.
        """
        if self.backoff_s > 0 or not self._is_idle():
            return False
        due = self.queue.queued(1, without_errors=DEAD_LETTER_CODES)
        if not due:
            return False
        try:
            receipt = self._uploader.upload(self._build_archive(due[0].visit), self._pause)
        except Busy:  # no failure: an exam is active, or the visit was reopened
            return False
        except (ReceiverUnreachable, ReceiverUntrusted, UploadUnauthorised) as error:
            if not self._worker.closing.is_set():
                self._record_failure(due[0], error, self.queue.queued(without_errors=DEAD_LETTER_CODES))
                self._back_off()
        except PERMANENT_ERRORS as error:
            self._record_failure(due[0], error, due)
        else:
            self._failures = 0
            self.queue.record_success(due[0], receipt)
            log.info("visit uploaded, confirmed by %s", receipt.confirmed, extra={"about": due[0].visit})
        return True

    def _record_failure(self, entry: QueuedVisit, error: DiffuscopeError, which: list[QueuedVisit]) -> None:
        log.warning("upload failed: %s", error, extra={"code": error.code, "about": entry.visit})
        self.queue.record_failure(which, error)

    def _back_off(self) -> None:
        """Delay the next attempt: BACKOFF_FIRST_S, doubled per failure up to BACKOFF_MAX_S, minus the random jitter."""
        wait_s = min(BACKOFF_FIRST_S * 2.0**self._failures, BACKOFF_MAX_S)
        self._failures = min(self._failures + 1, MAX_DOUBLINGS)
        self._due_s = self._clock.now_s() + wait_s * (1.0 - JITTER * self._random())

    def _pause(self) -> None:
        """Wait before a chunk while an exam is active; Busy after MAX_PAUSE_S or if the worker is closing."""
        until_s = self._clock.now_s() + MAX_PAUSE_S
        while not self._worker.closing.is_set():
            if self._is_idle():
                return
            if self._clock.now_s() > until_s:
                break
            self._worker.closing.wait(PAUSE_POLL_S)
        raise Busy("a patient is being examined, or the instrument is being switched off")


def archive_builder(store: CaptureStore, people: VisitRepository) -> Callable[[str], VisitArchive]:
    """Return a function that builds the archive of a visit from its id; Busy if the visit is not finished.

    The archive is the ZIP of the uploaded files.
    """

    def build(id: str) -> VisitArchive:
        visit = people.get(id)
        if visit.finished_at is None:
            raise Busy("the visit was opened again")
        name = folder_name(visit)
        return VisitArchive(name, zip_archive(name, uploaded_files(store, people, visit), visit.begun_at))

    return build
