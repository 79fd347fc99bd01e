"""Visits read from the shelf's tables, many at once in a fixed number of questions.

A row that cannot be read makes its own visit damaged: left out of lists, counted, and refused when asked for alone.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from datetime import date
from typing import Any, get_args

from sqlalchemy import Integer, case, func, literal_column, select
from sqlalchemy.orm import Session

from device.errors import NotKept, StoreDamaged
from services.records import reading
from services.records.protocol import Protocol
from services.records.reading import REMEDY, one_record, readable
from services.records.schema import KEPT, CaptureRow, FieldRow, IdentifierRow, ShotRow, SlotRow, VisitRow
from services.records.visit import Decided, Outcome, OutcomeCode, SlotState, Taken, Visit

PAGE = 500  # visits that are read at once where all are
_ID = re.compile(r"[0-9A-Za-z-]{1,60}", re.ASCII)
Pair = tuple[str, str]


def row(session: Session, id: str) -> VisitRow:
    """The row of a visit; NotKept if there is none, StoreDamaged if the name in it is another."""
    found = session.get(VisitRow, id) if _ID.fullmatch(id) else None
    if found is None:
        raise NotKept("this visit is not kept here", "Choose the person from the list.")
    if found.id != id:  # found by the index, which still says what the row no longer does
        raise StoreDamaged(f"the entry of the visit {id!r} has another name", REMEDY)
    return found


def consent(session: Session, id: str) -> tuple[str, str | None]:
    """The person's number and the recorded answer to the question of consent; NotKept if there is no such visit."""
    person = row(session, id).person
    answer = session.get(FieldRow, (id, "consent"))
    with one_record(id):
        value = None if answer is None else reading.parsed(answer.value)
        return person, None if value is None else reading.text(value)


def found(session: Session, limit: int, day: str | None, open: bool | None, digits: str | None) -> list[VisitRow]:
    """The newest rows, newest first, that fit all that is asked; a row without a name is none."""
    query = select(VisitRow).order_by(VisitRow.begun_at.desc(), VisitRow.id.desc()).limit(limit)
    if day is not None:
        query = query.where(VisitRow.day == day)
    if open is not None:
        query = query.where(VisitRow.finished_at.is_(None) if open else VisitRow.finished_at.is_not(None))
    if digits:
        query = query.where(func.instr(VisitRow.person, digits.upper()) > 0)
    return [row for row in session.scalars(query) if row is not None]


def counts(session: Session, day: str | None) -> dict[str, int]:
    """How many visits of a day (None: of all) are done, are to be finished, and were referred."""
    code = reading.json_part(VisitRow.outcome, "$.code")
    query = select(
        func.count(VisitRow.finished_at), func.count(), func.count(case((code.like("refer%"), 1)))
    ).select_from(VisitRow)
    done, every, referred = session.execute(query if day is None else query.where(VisitRow.day == day)).one()
    return {"done": done, "to_finish": every - done, "referred": referred}


def read(session: Session, protocol: Protocol, rows: Sequence[VisitRow]) -> list[Visit]:
    """The visits of these rows, in their order, without those that cannot be read."""
    known = readable(rows, _named)
    ids, fields = [row.id for row in known], _fields(session, known)
    taken, decided = _taken(session, ids), _decided(session, ids)

    def visit(row: VisitRow) -> Visit:
        with one_record(row.id):
            slots = {
                slot.id: SlotState(tuple(_shot(*one) for one in taken[row.id, slot.id]), _choice(decided, row, slot.id))
                for slot in protocol.slots
            }
            finished_at = None if row.finished_at is None else reading.moment(row.finished_at)
            answers = {reading.text(name): reading.parsed(value) for name, value in fields[row.id].items()}
            return Visit(
                row.id, row.person, _day(row.day), reading.moment(row.begun_at), answers, slots, finished_at,
                None if row.outcome is None else _outcome(row.outcome),
            )  # fmt: skip

    return readable(known, visit)


def read_one(session: Session, protocol: Protocol, row: VisitRow) -> Visit:
    """The visit of this row; StoreDamaged if it cannot be read."""
    found = read(session, protocol, [row])
    if not found:
        raise StoreDamaged(f"an entry of the visit {row.id!a} cannot be read", REMEDY)
    return found[0]


def damaged(session: Session, protocol: Protocol) -> int:
    """How many visits cannot be read."""
    many, last = 0, 0
    number = literal_column("visits.rowid", Integer)
    while True:
        query = select(number, VisitRow).where(number > last).order_by(number).limit(PAGE)
        rows = session.execute(query).all()
        if not rows:
            return many
        many += len(rows) - len(read(session, protocol, [row for _, row in rows if row is not None]))
        last = rows[-1][0]


def _named(row: VisitRow) -> VisitRow:
    """The same row, whose name and number can be asked for."""
    with one_record(row.id):
        if not _ID.fullmatch(reading.text(row.id)):
            raise ValueError("no name of a visit")
        reading.text(row.person)
    return row


def _day(value: object) -> str:
    return date.fromisoformat(reading.text(value)).isoformat()


def _outcome(value: object) -> Outcome:
    said = reading.parsed(value)
    code: OutcomeCode = reading.one_of(said["code"], *get_args(OutcomeCode))
    return Outcome(code, reading.text(said["sentence"]))


def _fields(session: Session, rows: Sequence[VisitRow]) -> dict[str, dict[str, Any]]:
    """The answers of each visit, and what tells who its person is, as they are kept."""
    out: dict[str, dict[str, Any]] = {row.id: {} for row in rows}
    for field in session.scalars(select(FieldRow).where(FieldRow.visit.in_(out))):
        if field.visit in out:  # found by an index that may still hold what the row no longer does
            out[field.visit][field.name] = field.value
    known: dict[str, dict[str, Any]] = defaultdict(dict)
    for one in session.scalars(select(IdentifierRow).where(IdentifierRow.person.in_({row.person for row in rows}))):
        known[one.person][one.name] = one.value
    return {row.id: out[row.id] | known[row.person] for row in rows}


def _taken(session: Session, ids: Sequence[str]) -> dict[Pair, list[tuple[object, object]]]:
    """The captures of each slot, oldest first, and what was thought of them, as it is kept."""
    query = (
        select(ShotRow.visit, ShotRow.slot, ShotRow.capture, reading.json_part(CaptureRow.report, "$.verdict"))
        .outerjoin(CaptureRow, CaptureRow.id == ShotRow.capture)  # one without its row still was taken
        .where(ShotRow.visit.in_(ids))
        .order_by(KEPT)
    )
    out: dict[Pair, list[tuple[object, object]]] = defaultdict(list)
    for visit, slot, capture, thought in session.execute(query):
        out[visit, slot].append((capture, thought))
    return out


def _shot(capture: object, thought: object) -> Taken:
    """A capture of a slot; of one whose report cannot be read nothing is known but that it was taken."""
    try:
        verdict = None if thought is None else reading.verdict(reading.parsed(thought))
    except (ValueError, TypeError, KeyError):
        verdict = None
    return Taken(reading.text(capture), verdict)


def _decided(session: Session, ids: Sequence[str]) -> dict[Pair, SlotRow]:
    query = select(SlotRow).where(SlotRow.visit.in_(ids))
    return {(row.visit, row.slot): row for row in session.scalars(query)}


def _choice(decided: dict[Pair, SlotRow], visit: VisitRow, slot: str) -> Decided | None:
    row = decided.get((visit.id, slot))
    if row is None:
        return None
    capture, reason = (None if value is None else reading.text(value) for value in (row.capture, row.reason))
    return Decided(capture, reason)
