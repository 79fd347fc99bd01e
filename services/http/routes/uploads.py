"""Endpoints of the upload queue: waiting visits with the last error of each, and an immediate retry."""

from fastapi import APIRouter, Request

from device.errors import DiffuscopeError
from services.delivery.upload_worker import UploadWorker
from services.errors import RecordNotFound, StoreDamaged, UploadDisabled, UploadError
from services.http.access import may
from services.http.schemas.problems import ErrorText
from services.http.schemas.uploads import QueueAnswer, UploadRetry, WaitingVisit
from services.records.upload_queue import QueuedVisit

MAX_LISTED = 200
READING = "GET /api/visits"  # who may not send it gets no patient numbers
UPLOAD_ERRORS: tuple[type[DiffuscopeError], ...] = (*UploadError.__subclasses__(), StoreDamaged, RecordNotFound)
REMEDIES = {kind.code: kind.default_remedy for kind in UPLOAD_ERRORS}


def upload_router(sender: UploadWorker | None) -> APIRouter:
    """Return the router of the upload queue; `sender` None means that no receiver is set up."""
    router = APIRouter()

    @router.get("/api/upload-queue")
    def upload_queue(request: Request) -> QueueAnswer:
        """Return the visits in the upload queue, the longest waiting first, and the seconds until the next try.

        `configured` is false, and the queue empty, if no receiver is set up.
        """
        return queue_answer(sender, may(request, READING))

    @router.post("/api/upload-queue/retry")
    def retry_now(request: Request, order: UploadRetry) -> QueueAnswer:
        """Retry uploads at once, without waiting for the backoff; 409 (`send.off`) if no receiver is set up."""
        if sender is None:
            raise UploadDisabled("no receiver is set up")
        sender.retry_now(order.visit)
        return queue_answer(sender, may(request, READING))

    return router


def queue_answer(sender: UploadWorker | None, has_numbers: bool) -> QueueAnswer:
    """Return the upload queue, at most `MAX_LISTED` visits, with the patient numbers or without; empty if no sender."""
    if sender is None:
        return QueueAnswer(configured=False, sent=0, waiting=0, next_try_s=0.0, visits=[])
    visits = [_waiting_visit(entry, has_numbers) for entry in sender.queue.queued(MAX_LISTED, sizes=True)]
    counts = sender.counts()
    return QueueAnswer(
        configured=True, sent=counts.sent, waiting=counts.waiting, next_try_s=round(sender.backoff_s, 1), visits=visits
    )


def _waiting_visit(entry: QueuedVisit, has_number: bool) -> WaitingVisit:
    error = None
    if entry.error:
        error = ErrorText(code=entry.error, message=entry.message or "", remedy=REMEDIES.get(entry.error, ""))
    return WaitingVisit(
        visit=entry.visit,
        number=entry.number if has_number else None,
        since=entry.finished_at,
        size_bytes=entry.size_bytes,
        tries=entry.tries,
        failing_since=entry.failing_since,
        error=error,
        stuck=entry.stuck,
    )
