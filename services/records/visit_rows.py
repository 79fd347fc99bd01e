"""Changes of the rows of a visit within a transaction: finish with its outcome, decisions on slots."""

import json

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from services.errors import VisitFinished
from services.records import visit_queries
from services.records.answers import IDENTIFIERS
from services.records.json_values import FormValue, JsonValue
from services.records.patient_rows import index_of
from services.records.programme import Programme
from services.records.record_document import as_object
from services.records.row_validation import parsed_json, reading_record
from services.records.schema import ChangeRow, SlotDecisionRow, VisitRow
from services.records.visit import SlotDecision, decide_outcome


def unfinished_row(session: Session, id: str) -> VisitRow:
    """Return the row of an unfinished visit; VisitFinished if it is finished, RecordNotFound if unknown."""
    row = visit_queries.visit_row(session, id)
    if row.finished_at is not None:
        raise VisitFinished("this visit is finished")
    return row


def record_change(
    session: Session,
    visit: str,
    field: str,
    was: JsonValue,
    value: FormValue,
    at: str,
    user: str,
    why: str | None = None,
) -> None:
    """Add one change of a visit at a time (UTC text) to its history, identifying values encrypted; none if equal."""
    if was == value:
        return
    if field in IDENTIFIERS:
        index, patient = index_of(session), visit_queries.visit_row(session, visit).patient
        was, value = index.encrypted(patient, was), index.encrypted(patient, value)
    number = session.scalar(select(func.max(ChangeRow.number)).where(ChangeRow.visit == visit)) or 0
    values = {"was": json.dumps(was), "value": json.dumps(value)}
    session.add(ChangeRow(visit=visit, number=number + 1, at=at, user=user, field=field, why=why, **values))


def outcome_code(row: VisitRow) -> JsonValue:
    """Return the code of the stored outcome, None in an unfinished visit; StoreDamaged if it cannot be read."""
    if row.outcome is None:
        return None
    with reading_record(row.id):
        return as_object(parsed_json(row.outcome))["code"]


def finish(session: Session, programme: Programme, row: VisitRow, at: str, user: str = "") -> None:
    """Store the outcome of a visit, computed from its present answers and slots, and the time (UTC text) of its end.

    `user`: who finished it, "" for the device, as after a late picture.
    """
    visit = visit_queries.read_visit(session, programme, row)
    ending = decide_outcome(programme, visit.fields, visit.slots)
    record_change(session, row.id, "outcome", outcome_code(row), ending.code, at, user)
    row.outcome = json.dumps(ending.model_dump())
    row.finished_at = at


def decide(session: Session, visit: str, slot: str, decided: SlotDecision | None) -> None:
    """Write the decision on a slot; None deletes it."""
    if decided is not None:
        session.merge(SlotDecisionRow(visit=visit, slot=slot, capture=decided.capture, reason=decided.reason))
    elif (row := session.get(SlotDecisionRow, (visit, slot))) is not None:
        session.delete(row)
