"""Changes of the rows of a visit within a transaction: finish with its outcome, decisions on slots."""

import json

from sqlalchemy.orm import Session

from services.errors import VisitFinished
from services.records import visit_queries
from services.records.programme import Programme
from services.records.schema import SlotDecisionRow, VisitRow
from services.records.visit import SlotDecision, decide_outcome


def unfinished_row(session: Session, id: str) -> VisitRow:
    """Return the row of an unfinished visit; VisitFinished if it is finished, RecordNotFound if unknown."""
    row = visit_queries.visit_row(session, id)
    if row.finished_at is not None:
        raise VisitFinished(f"{row.patient} is finished")
    return row


def finish(session: Session, programme: Programme, row: VisitRow, at: str) -> None:
    """Store the outcome of a visit, computed from its present answers and slots, and the time (UTC text) of its end."""
    visit = visit_queries.read_visit(session, programme, row)
    ending = decide_outcome(programme, visit.fields, visit.slots)
    row.outcome = json.dumps({"code": ending.code, "sentence": ending.sentence})
    row.finished_at = at


def decide(session: Session, visit: str, slot: str, decided: SlotDecision | None) -> None:
    """Write the decision on a slot; None deletes it."""
    if decided is not None:
        session.merge(SlotDecisionRow(visit=visit, slot=slot, capture=decided.capture, reason=decided.reason))
    elif (row := session.get(SlotDecisionRow, (visit, slot))) is not None:
        session.delete(row)
