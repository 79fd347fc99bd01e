"""Endpoints of patients and visits: read, change, and the control lease of the screens."""

import re
from collections.abc import Callable
from datetime import date
from typing import Annotated

from fastapi import APIRouter, Query, Request
from pydantic import BeforeValidator

from services.http.access import signed_in
from services.http.control_lease import ControlLease
from services.http.schemas.captures import LateralityCorrection
from services.http.schemas.common import IdempotentRequest
from services.http.schemas.visits import (
    ControlRequest,
    FieldValue,
    LeaseAnswer,
    MissingPicture,
    NewVisit,
    Reopening,
    SlotChoice,
    VisitCounts,
    VisitList,
)
from services.instrument.pending_captures import PendingCaptures
from services.records.programme import Programme
from services.records.row_validation import reading_record, without_damaged
from services.records.visit import Visit
from services.records.visit_document import ChangeList, VisitDocument, visit_document
from services.records.visit_repository import VisitRepository

ISO_DATE = re.compile("[0-9]{4}-[0-9]{2}-[0-9]{2}")


def iso_date(text: str | None) -> str | None:
    """Return the text of a date, YYYY-MM-DD; ValueError for any other, as a number of seconds."""
    if text is not None and not ISO_DATE.fullmatch(text):
        raise ValueError("a date is written YYYY-MM-DD")
    return text


def visits_router(
    repository: VisitRepository, lease: ControlLease, pending: PendingCaptures, finished: Callable[[], None]
) -> APIRouter:
    """Return the router of patients, visits and the control lease; `finished` is called after each finished visit."""
    router = APIRouter()
    router.include_router(_read_router(repository))
    router.include_router(_form_router(repository))
    router.include_router(_slot_router(repository))
    router.include_router(_end_router(repository, pending, finished))
    router.include_router(_laterality_router(repository, lease))
    router.include_router(_lease_router(lease))
    return router


def _read_router(repository: VisitRepository) -> APIRouter:
    """Return the router of the endpoints that read the programme and visits."""
    router = APIRouter()

    @router.get("/api/programme")
    def programme() -> Programme:
        """Return the programme: picture slots, form fields and rules of a visit."""
        return repository.programme

    @router.get("/api/visits")
    def visits(
        day: Annotated[date | None, BeforeValidator(iso_date)] = None,
        open: bool | None = None,
        q: str | None = Query(None, max_length=20, pattern="^[0-9A-Za-z-]*$"),
        limit: int = Query(50, ge=1, le=500),
    ) -> VisitList:
        """List visits, the newest first, with the counts of that day, or of all.

        `day` is the date of the visit; `open`: true for unfinished, false for finished visits; `q`: part of the patient
        number.
        """
        on = day.isoformat() if day else None
        found = without_damaged(repository.visits(limit, on, open, q), lambda visit: visit_answer(visit, repository))
        return VisitList(visits=found, counts=VisitCounts.model_validate(repository.counts(on)))

    @router.get("/api/visits/{id}")
    def visit(id: str) -> VisitDocument:
        """Return one visit; 404 for an unknown id, 500 if the stored visit is damaged."""
        return visit_answer(repository.get(id), repository)

    @router.get("/api/visits/{id}/changes")
    def changes(id: str) -> ChangeList:
        """Return the history of a visit: answers, consent, outcome and laterality, with user, time, before and after.

        404 for an unknown id, 500 if the stored visit is damaged.
        """
        return ChangeList(changes=repository.changes(id))

    return router


def _form_router(repository: VisitRepository) -> APIRouter:
    """Return the router of the endpoints that begin a visit and fill its form."""
    router = APIRouter()

    @router.post("/api/visits", status_code=201)
    def begin(order: NewVisit, request: Request) -> VisitDocument:
        """Begin a visit; without a number, of a new patient with the next automatic number.

        Answers 201 with the visit; 422 for an invalid number, or an automatic number with a wrong check digit.
        """
        visit = repository.begin(order.key, order.number)
        request.state.audit_record, request.state.audit_patient = visit.id, visit.patient_id
        return visit_answer(visit, repository)

    @router.patch("/api/visits/{id}")
    def answer(id: str, order: FieldValue, request: Request) -> VisitDocument:
        """Set or clear one form field of a visit.

        404 for an unknown visit, 409 for a finished one, 422 for an unknown field or an invalid value.
        """
        request.state.audit_field = order.field
        visit = repository.answer(order.key, id, order.field, order.value, signed_in(request).name)
        request.state.audit_patient = visit.patient_id
        return visit_answer(visit, repository)

    return router


def _slot_router(repository: VisitRepository) -> APIRouter:
    """Return the router of the endpoints that fill picture slots."""
    router = APIRouter()

    @router.post("/api/visits/{id}/not-possible")
    def record_missing_picture(id: str, order: MissingPicture) -> VisitDocument:
        """Record that a picture could not be taken.

        404 for an unknown visit or slot, 409 for a finished visit, 422 for an unknown reason.
        """
        return visit_answer(repository.pictures.mark_not_possible(order.key, id, order.slot, order.reason), repository)

    @router.post("/api/visits/{id}/slots")
    def choose(id: str, order: SlotChoice) -> VisitDocument:
        """Fill a picture slot with one of its captures, or empty it.

        404 for an unknown visit or slot, or a capture of another slot; 409 for a finished visit.
        """
        return visit_answer(repository.pictures.choose(order.key, id, order.slot, order.capture), repository)

    @router.post("/api/captures/{id}/accept")
    def keep(id: str, order: IdempotentRequest) -> VisitDocument:
        """Fill the capture's own slot with this capture; 404 for a test picture, 409 for a finished visit."""
        return visit_answer(repository.pictures.accept_capture(order.key, id), repository)

    return router


def _end_router(repository: VisitRepository, pending: PendingCaptures, finished: Callable[[], None]) -> APIRouter:
    """Return the router of the end of a visit."""
    router = APIRouter()

    @router.post("/api/visits/{id}/finish")
    def finish(id: str, order: IdempotentRequest, request: Request) -> VisitDocument:
        """Finish a visit, once no capture of it is pending or after 60 s; a finished visit stays unchanged.

        Answers with the visit and its outcome; 404 for an unknown visit.
        """
        pending.wait(id)
        visit = repository.finish(order.key, id, signed_in(request).name)
        finished()
        return visit_answer(visit, repository)

    @router.post("/api/visits/{id}/reopen")
    def reopen(id: str, order: Reopening, request: Request) -> VisitDocument:
        """Reopen a finished visit on the day of its finish, for a reason that its history keeps; 409 on a later day."""
        return visit_answer(repository.reopen(order.key, id, order.reason, signed_in(request).name), repository)

    return router


def _laterality_router(repository: VisitRepository, lease: ControlLease) -> APIRouter:
    """Return the router of the correction of a capture's eye."""
    router = APIRouter()

    @router.post("/api/captures/{id}/eye")
    def correct_laterality(id: str, order: LateralityCorrection, request: Request) -> VisitDocument:
        """Correct the laterality of a capture: move it to the slot of `eye` with the same field of view.

        If it already belongs to that eye, it stays in place. The report records the correction or confirmation, and the
        laterality is not questioned again. Answers with the visit; 404 for an unknown capture or one without a visit,
        409 for a finished visit, 422 if the programme has no such slot.
        """
        user = signed_in(request).name
        visit = repository.pictures.correct_laterality(order.key, id, order.eye, lease.holder, user)
        return visit_answer(visit, repository)

    return router


def _lease_router(lease: ControlLease) -> APIRouter:
    """Return the router of the control lease."""
    router = APIRouter()

    @router.post("/api/controller")
    def controller(asking: ControlRequest) -> LeaseAnswer:
        """Acquire, take over or release the control lease.

        Answers with the public name of the present or last holder (`lease`) and whether this screen holds it (`mine`).
        """
        state = lease.release(asking.key) if asking.release else lease.acquire(asking.key, asking.take)
        return LeaseAnswer(lease=state.lease, mine=state.mine)

    return router


def visit_answer(visit: Visit, repository: VisitRepository) -> VisitDocument:
    """Return a visit with its identifying fields and the time until which its finish can be undone.

    StoreDamaged if the stored answer to a form field has another type than any release wrote.
    """
    with reading_record(visit.id):
        return visit_document(visit, repository.undo_until(visit))
