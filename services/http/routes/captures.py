"""Endpoints of captures: take a picture, list and read captures and their files."""

import asyncio
from collections.abc import Callable
from pathlib import Path

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as InPath
from fastapi.concurrency import run_in_threadpool

from services.errors import RecordNotFound
from services.http.access import require_light_role
from services.http.media import file_responses
from services.http.schemas.captures import CaptureAnswer, CaptureList, NewCapture, capture_answer
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import HeadArbiter
from services.instrument.pending_captures import PendingCaptures
from services.records.capture import Capture
from services.records.capture_store import CaptureStore
from services.records.capture_target import CaptureTarget
from services.records.visit_repository import VisitRepository

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".tiff": "image/tiff", ".json": "application/json"}


def press_router(
    exam: Callable[[], ExamService], store: CaptureStore, repository: VisitRepository, pending: PendingCaptures
) -> APIRouter:
    """Return the router of the endpoint that takes pictures; the application adds the check of the control lease.

    `exam` returns the exam that owns the head, or raises the reason why none does. `pending` holds the captures that
    the request which finishes their visit waits for.
    """
    router = APIRouter()
    pictures = repository.pictures

    def stored_or_target(press: NewCapture) -> Capture | CaptureTarget:
        """Return the capture that a repeated request has stored, perhaps before a restart, else its target."""
        key = press.key
        known_id = pictures.capture_for_key(key, press.eye, press.visit, press.slot) if key else None
        if known_id is not None:
            return store.get(known_id)
        return pictures.capture_target(press.eye, key, press.visit, press.slot)

    @router.post("/api/captures", status_code=201)
    async def create_capture(press: NewCapture, request: Request) -> CaptureAnswer:
        """Take one picture and store it.

        With `visit` and `slot` the picture belongs to that slot, and the visit needs a given consent; without them it
        is a test picture of a technician. `key` is an idempotency key: a repeated request returns the first capture,
        also after a restart of the server. Answers 201 with the capture once it is stored. Refused before it is
        accepted: 401 and 403 without the right, 403 for a cross-origin request (CSRF), 404 for an unknown visit or
        slot, 409 while the camera is busy, without consent, in a finished visit, for a key of another request or while
        another screen holds the control lease, 422 for an invalid body or a slot of the other eye, 423 without a valid
        calibration, 500 or 503 if the store cannot be read. Failed after it: 409 if the consent was withdrawn or the
        server is stopping, 423 if light, heat or power forbid the exposure, 500 if the store is damaged, 503 if a part
        of the head does not answer or the store is locked or read-only, 507 if the disk is full.
        """
        request.state.audit_record = press.visit or ""
        require_light_role(request, press.visit)
        found = await run_in_threadpool(stored_or_target, press)  # reads the database
        if isinstance(found, Capture):
            return capture_answer(found)
        future = exam().press(press.eye, press.key, found)
        if press.visit is not None:
            pending.add(press.visit, future)
        return capture_answer(await asyncio.wrap_future(future))

    return router


def captures_router(store: CaptureStore, arbiter: HeadArbiter) -> APIRouter:
    """Return the router of stored captures and their files; `arbiter` has the quick look of a capture in progress."""
    router = APIRouter()

    @router.get("/api/captures")
    def captures(limit: int = Query(50, ge=1, le=500), before: str | None = None) -> CaptureList:
        """List captures, the newest first.

        At most `limit` captures; `before` is the id of the last one of the previous page.
        """
        return CaptureList(captures=[capture_answer(record) for record in store.captures(limit, before)])

    @router.get("/api/captures/{id}")
    def capture(id: str) -> CaptureAnswer:
        """Return one capture; 404 for an unknown id, 500 if the stored capture is damaged."""
        return capture_answer(store.get(id))

    @router.get("/api/captures/{id}/{name}", response_class=Response, responses=file_responses(*MEDIA_TYPES.values()))
    def file(id: str, name: str = InPath(pattern="^[a-z]+(-([0-9]+|[a-z]+))?[.](png|jpg|tiff|json)$")) -> Response:
        """Return one file of a capture.

        `picture-1.png`, `colour-1.png` and `report-1.json` are those of its first later version. `quick.jpg` is the
        picture that is shown first, reduced, and of a capture in progress its quick look; `green.jpg` is `picture.png`
        reduced. 404 for an unknown capture or file, 500 for a damaged one.
        """
        exam = arbiter.owner.exam
        quick = exam.quick(id) if name == "quick.jpg" and exam is not None else None
        try:
            content = store.read(id, name)
        except RecordNotFound:
            if quick is None:
                raise
            content = quick
        return Response(content, media_type=MEDIA_TYPES[Path(name).suffix])

    return router
