"""Repository of patients and visits: each change is one durable transaction, idempotent by the key of its request."""

import json
import secrets
from datetime import datetime, timedelta

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from device.clock import Clock
from services.errors import VisitFinished
from services.records import answers, numbering, patient_rows, schema, visit_queries, visit_rows
from services.records.idempotent_requests import IdempotentRequests
from services.records.programme import Programme
from services.records.schema import AnswerRow, VisitRow
from services.records.storage_errors import storage_errors
from services.records.visit import ReopenReason, Visit
from services.records.visit_document import VisitChange
from services.records.visit_pictures import VisitPictures


class VisitRepository:
    """Patients and visits in the database of the capture store; thread-safe, writers are serialised.

    Each changing method takes an idempotency key first: a repeated request with the same key changes nothing and
    returns the present state of the same visit; another request with the same key is an IdempotencyKeyConflict.
    `pictures`: the pictures of the visits; `requests`: the keys of completed requests.
    """

    def __init__(self, engine: Engine, programme: Programme, clock: Clock) -> None:
        self.programme, self.clock, self._engine = programme, clock, engine
        self.requests = IdempotentRequests(engine, clock)
        self.pictures = VisitPictures(engine, programme, clock, self.requests, self.get)

    def begin(self, key: str, number: str | None = None) -> Visit:
        """Begin a visit of the patient with that number, known or new; without a number, of a new patient.

        A new patient without a number gets the next automatic number. InputError for an invalid number, or for one
        in the form of an automatic number (prefix and digits) with a wrong check digit.
        """

        number = None if number is None else numbering.normalise(number)
        request = f"begin {number}"

        def act(session: Session) -> str:
            now = self.clock.wall()
            self.requests.delete_expired(session)
            prefix = self.programme.numbers.prefix
            begun_at = schema.utc_text(now)
            patient = patient_rows.patient_of_number(session, prefix, number, begun_at)
            id = f"{now:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}"
            day = now.astimezone().date().isoformat()
            reference = self.requests.reference(key, request)
            session.add(VisitRow(id=id, patient=patient, day=day, begun_at=begun_at, request=reference))
            return id

        return self.get(self.requests.run_in_transaction(key, request, act))

    def get(self, id: str) -> Visit:
        """Return one visit; RecordNotFound if unknown, StoreDamaged if its rows cannot be read."""
        with storage_errors(), Session(self._engine) as session:
            return visit_queries.read_visit(session, self.programme, visit_queries.visit_row(session, id))

    def visits(
        self, limit: int, day: str | None = None, open: bool | None = None, number: str | None = None
    ) -> list[Visit]:
        """Return the newest visits, newest first, at most `limit`, without those that cannot be read.

        `day`: date (ISO 8601) of the visit; `open`: True for unfinished, False for finished visits; `number`: a part of
        the patient's number.
        """
        number = numbering.join_check_digit(number.upper()) if number else None
        with storage_errors(), Session(self._engine) as session:
            return visit_queries.read_visits(
                session, self.programme, visit_queries.find_rows(session, limit, day, open, number)
            )

    def damaged(self) -> int:
        """Return the number of visits whose rows cannot be read.

        Lists omit these visits, and `get` raises StoreDamaged.
        """
        with storage_errors(), Session(self._engine) as session:
            return visit_queries.damaged(session, self.programme)

    def counts(self, day: str | None = None) -> dict[str, int]:
        """Return the numbers of visits of a day (None: all): finished (`done`), `to_finish`, `referred`, `declined`."""
        with storage_errors(), Session(self._engine) as session:
            return visit_queries.counts(session, day)

    def changes(self, id: str) -> list[VisitChange]:
        """Return the history of a visit, the first change first; errors as in `get`."""
        with storage_errors(), Session(self._engine) as session:
            return visit_queries.changes(session, self.programme, visit_queries.visit_row(session, id))

    def answer(self, key: str, id: str, name: str, value: object, user: str = "") -> Visit:
        """Store the answer to the form field `name` of a visit; None is stored as no answer.

        `user` and the value before enter the history of the visit. Identifying fields belong to the patient, so all
        visits of the patient show them; None deletes the field.
        Errors: InputError (unknown field, invalid answer), VisitFinished, RecordNotFound (unknown visit).
        """
        value = answers.validate_answer(name, value)

        def act(session: Session) -> str:
            patient = visit_rows.unfinished_row(session, id).patient
            now = schema.utc_text(self.clock.wall())
            if name in answers.IDENTIFIERS:
                was = patient_rows.set_field(session, patient, name, value)
            else:  # null is an answer too: no drops were given
                was = visit_queries.answer(session, id, name)
                session.merge(AnswerRow(visit=id, name=name, value=json.dumps(value), set_at=now))
            visit_rows.record_change(session, id, name, was, value, now, user)
            return id

        return self.get(self.requests.run_in_transaction(key, f"answer {id} {name} {json.dumps(value)}", act))

    def finish(self, key: str, id: str, user: str = "") -> Visit:
        """Finish a visit with its present captures and compute its outcome; a finished visit stays unchanged."""

        def act(session: Session) -> str:
            row = visit_queries.visit_row(session, id)
            if row.finished_at is None:
                visit_rows.finish(session, self.programme, row, schema.utc_text(self.clock.wall()), user)
            return id

        return self.get(self.requests.run_in_transaction(key, f"finish {id}", act))

    def reopen(self, key: str, id: str, reason: ReopenReason, user: str = "") -> Visit:
        """Undo the finish of a visit and delete its outcome, which its history keeps with the reason.

        VisitFinished after the local day of the finish.
        """

        def act(session: Session) -> str:
            row = visit_queries.visit_row(session, id)
            if row.finished_at is not None and self._end_of_undo(datetime.fromisoformat(row.finished_at)) is None:
                raise VisitFinished("this visit was finished on an earlier day")
            now = schema.utc_text(self.clock.wall())
            visit_rows.record_change(session, id, "outcome", visit_rows.outcome_code(row), None, now, user, reason)
            row.finished_at = row.outcome = None
            return id

        return self.get(self.requests.run_in_transaction(key, f"reopen {id} {reason}", act))

    def undo_until(self, visit: Visit) -> datetime | None:
        """Return the end of the local day on which a visit was finished, until which `reopen` is possible.

        None for an unfinished visit, and after that time.
        """
        return None if visit.finished_at is None else self._end_of_undo(visit.finished_at)

    def _end_of_undo(self, finished_at: datetime) -> datetime | None:
        day = finished_at.astimezone().replace(hour=0, minute=0, second=0, microsecond=0)
        end = day + timedelta(days=1)
        return end if self.clock.wall() < end else None
