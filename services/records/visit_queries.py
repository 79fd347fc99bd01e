"""Queries on visits; a list of visits needs a fixed number of SQL statements.

An unreadable row affects only its own visit: lists omit the visit, `damaged` counts it, and `read_visit` raises
StoreDamaged.
"""

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from datetime import date

from pydantic import TypeAdapter
from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from device.values import ChannelUse
from services.errors import RecordNotFound, StoreDamaged
from services.records import patient_rows, row_validation
from services.records.answers import IDENTIFIERS
from services.records.capture import StoredVerdict
from services.records.json_values import JsonValue
from services.records.patient_rows import index_of
from services.records.programme import Programme
from services.records.record_rows import visit_contents
from services.records.record_signing import refuse_changed
from services.records.row_validation import REMEDY, reading_record, without_damaged
from services.records.schema import (
    CAPTURE_ROWID,
    VISIT_ROWID,
    AnswerRow,
    CaptureRow,
    CaptureSlotRow,
    ChangeRow,
    PatientRow,
    SlotDecisionRow,
    VisitRow,
    json_extract_or_null,
)
from services.records.visit import Outcome, SlotCapture, SlotDecision, SlotState, Visit, no_colour_of
from services.records.visit_document import VisitChange

PAGE_ROWS = 500  # visits per query where all visits are read
_CHANNELS = TypeAdapter(tuple[ChannelUse, ...])
_ID = re.compile(r"[0-9A-Za-z-]{1,60}", re.ASCII)
SlotKey = tuple[str, str]


def visit_row(session: Session, id: str) -> VisitRow:
    """Return the row of a visit; RecordNotFound if unknown, StoreDamaged if its id differs from the requested one."""
    found = session.get(VisitRow, id) if _ID.fullmatch(id) else None
    if found is None:
        raise RecordNotFound("this visit is not saved here", "Choose the patient from the list.")
    if found.id != id:  # the index still holds the id, the row does not
        raise StoreDamaged(f"the entry of the visit {id!r} has another name", REMEDY)
    return found


def consent(session: Session, id: str) -> str | None:
    """Return the recorded answer of a visit to the consent question (None: no answer).

    RecordNotFound if the visit is unknown, StoreDamaged if the answer cannot be read.
    """
    visit_row(session, id)
    value = answer(session, id, "consent")
    with reading_record(id):
        return None if value is None else row_validation.text(value)


def answer(session: Session, id: str, name: str) -> JsonValue:
    """Return the answer of a visit to a form field, None without one; StoreDamaged if it cannot be read."""
    row = session.get(AnswerRow, (id, name))
    with reading_record(id):
        return None if row is None else row_validation.parsed_json(row.value)


def changes(session: Session, programme: Programme, row: VisitRow) -> list[VisitChange]:
    """Return the history of a visit, the first change first; StoreDamaged if the visit cannot be read."""
    read_visit(session, programme, row)
    query = select(ChangeRow).where(ChangeRow.visit == row.id).order_by(ChangeRow.number)
    with reading_record(row.id):
        return [
            VisitChange.model_validate(
                {
                    "number": change.number,
                    "at": row_validation.timestamp(change.at),
                    "user": change.user,
                    "field": change.field,
                    "was": _changed_value(session, row, change.field, change.was),
                    "value": _changed_value(session, row, change.field, change.value),
                    "why": change.why,
                }
            )
            for change in session.scalars(query)
        ]


def _changed_value(session: Session, row: VisitRow, field: str, stored: object) -> JsonValue:
    value = row_validation.parsed_json(stored)
    return index_of(session).decrypted(row.patient, value) if field in IDENTIFIERS else value


def find_rows(session: Session, limit: int, day: str | None, open: bool | None, number: str | None) -> list[VisitRow]:
    """Return the newest `limit` visit rows, newest first, that match all given filters.

    Of these, rows without an id are omitted: there may be fewer. The order is that of their begin (row number),
    independent of the clock. `day`: date of the visit; `open`: True for unfinished, False for finished; `number`: part
    of the patient's number.
    """
    query = select(VisitRow).order_by(VISIT_ROWID.desc()).limit(limit)
    if day is not None:
        query = query.where(VisitRow.day == day)
    if open is not None:
        query = query.where(VisitRow.finished_at.is_(None) if open else VisitRow.finished_at.is_not(None))
    if number:
        found = [id for id, known in index_of(session).numbers(session).items() if number.upper() in known]
        ids = func.json_each(json.dumps(found)).table_valued("value")  # one parameter, however many there are
        query = query.where(VisitRow.patient.in_(select(ids.c.value)))
    return [row for row in session.scalars(query) if row is not None]


def counts(session: Session, day: str | None) -> dict[str, int]:
    """Return the numbers of finished (`done`), unfinished (`to_finish`), `referred` and `declined` visits of a day.

    `day`: None for all days. `done` includes the last two.
    """
    code = json_extract_or_null(VisitRow.outcome, "$.code")
    query = select(
        func.count(VisitRow.finished_at),
        func.count(),
        func.count(case((code.like("refer%"), 1))),
        func.count(case((code == "declined", 1))),
    ).select_from(VisitRow)
    done, every, referred, declined = session.execute(query if day is None else query.where(VisitRow.day == day)).one()
    return {"done": done, "to_finish": every - done, "referred": referred, "declined": declined}


def read_visits(session: Session, programme: Programme, rows: Sequence[VisitRow]) -> list[Visit]:
    """Return the visits of these rows, in the same order, without those that cannot be read."""
    known = without_damaged(rows, _checked_row)
    contents = visit_contents(session, known)
    ids = [row.id for row in known]
    fields = _answers(session, ids)
    query = select(PatientRow).where(PatientRow.patient_id.in_({row.patient for row in known}))
    identities = {row.patient_id: row.identity for row in session.scalars(query)}
    taken = _taken(session, ids)
    decided = _decided(session, ids)

    def visit(row: VisitRow) -> Visit:
        with reading_record(row.id):
            refuse_changed("visit", row, contents[row.id])
            number, identifiers = index_of(session).identity(row.patient, identities[row.patient])
            slots = {
                slot.id: SlotState(
                    tuple(_taken_capture(*columns) for columns in taken[row.id, slot.id]),
                    _choice(decided, row, slot.id),
                )
                for slot in programme.slots
            }
            finished_at = None if row.finished_at is None else row_validation.timestamp(row.finished_at)
            values = {name: row_validation.parsed_json(value) for name, value in fields[row.id].items()} | identifiers
            answers = {row_validation.text(name): row_validation.form_value(value) for name, value in values.items()}
            return Visit(
                row.id,
                row.patient,
                number,
                _day(row.day),
                row_validation.timestamp(row.begun_at),
                answers,
                slots,
                finished_at,
                None if row.outcome is None else Outcome.model_validate(row_validation.parsed_json(row.outcome)),
            )

    return without_damaged(known, visit)


def read_visit(session: Session, programme: Programme, row: VisitRow) -> Visit:
    """Return the visit of this row; RecordErased if its patient was erased, StoreDamaged if it cannot be read."""
    found = read_visits(session, programme, [row])
    if not found:
        patient_rows.identity(session, _checked_row(row).patient)
        raise StoreDamaged(f"an entry of the visit {row.id!a} cannot be read", REMEDY)
    return found[0]


def damaged(session: Session, programme: Programme) -> int:
    """Return the number of visits that cannot be read."""
    many, last = 0, 0
    while True:
        query = select(VISIT_ROWID, VisitRow).where(last < VISIT_ROWID).order_by(VISIT_ROWID).limit(PAGE_ROWS)
        rows = session.execute(query).all()
        if not rows:
            return many
        many += len(rows) - len(read_visits(session, programme, [row for _, row in rows if row is not None]))
        last = rows[-1][0]


def _checked_row(row: VisitRow) -> VisitRow:
    """Return the row unchanged; StoreDamaged if its id is not that of a visit, or its patient id no text."""
    with reading_record(row.id):
        if not _ID.fullmatch(row_validation.text(row.id)):
            raise ValueError("no name of a visit")
        row_validation.text(row.patient)
    return row


def _day(value: object) -> str:
    return date.fromisoformat(row_validation.text(value)).isoformat()


def _answers(session: Session, ids: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the answers of each visit, as JSON texts, by visit id and field name."""
    out: dict[str, dict[str, str]] = {id: {} for id in ids}
    for field in session.scalars(select(AnswerRow).where(AnswerRow.visit.in_(out))):
        if field.visit in out:  # a damaged row may differ from the index
            out[field.visit][field.name] = field.value
    return out


def _taken(session: Session, ids: Sequence[str]) -> dict[SlotKey, list[tuple[object, ...]]]:
    """Return (id, verdict, method, channels) of each capture by (visit, slot), oldest first; JSON texts or None."""
    query = (
        select(
            CaptureSlotRow.visit,
            func.coalesce(CaptureRow.slot, CaptureSlotRow.slot),  # a capture with a damaged row keeps its slot
            CaptureSlotRow.capture,
            CaptureRow.verdict,
            json_extract_or_null(CaptureRow.report, "$.method"),
            json_extract_or_null(CaptureRow.report, "$.channels"),
        )
        .outerjoin(
            CaptureRow, CaptureRow.id == CaptureSlotRow.capture
        )  # a capture without its row still counts as taken
        .where(CaptureSlotRow.visit.in_(ids))
        .order_by(CAPTURE_ROWID)
    )
    out: dict[SlotKey, list[tuple[object, ...]]] = defaultdict(list)
    for visit, slot, *stored in session.execute(query):
        out[visit, slot].append(tuple(stored))
    return out


def _taken_capture(capture: object, verdict_json: object, method: object, channels_json: object) -> SlotCapture:
    """Return a capture of a slot; ValueError for an id that is no text.

    The verdict is None if it is missing or unreadable; `no_colour` is None if the report is.
    """
    try:
        verdict = None if verdict_json is None else StoredVerdict.parse(verdict_json)
    except (ValueError, TypeError, KeyError):
        verdict = None
    try:
        channels = () if channels_json is None else _CHANNELS.validate_python(row_validation.parsed_json(channels_json))
        no_colour = None if method is None else no_colour_of(row_validation.text(method), channels)
    except (ValueError, TypeError, KeyError):
        no_colour = None
    return SlotCapture(row_validation.text(capture), verdict, no_colour)


def _decided(session: Session, ids: Sequence[str]) -> dict[SlotKey, SlotDecisionRow]:
    query = select(SlotDecisionRow).where(SlotDecisionRow.visit.in_(ids))
    return {(row.visit, row.slot): row for row in session.scalars(query)}


def _choice(decided: dict[SlotKey, SlotDecisionRow], visit: VisitRow, slot: str) -> SlotDecision | None:
    row = decided.get((visit.id, slot))
    if row is None:
        return None
    capture, reason = (None if value is None else row_validation.text(value) for value in (row.capture, row.reason))
    return SlotDecision(capture, reason)
