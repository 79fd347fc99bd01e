"""Visits read from the shelf's tables, many at once in a fixed number of questions."""

import json
import re
from collections import defaultdict
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from device.errors import NotKept
from services.records.protocol import Protocol
from services.records.schema import KEPT, CaptureRow, FieldRow, IdentifierRow, ShotRow, SlotRow, VisitRow
from services.records.visit import Decided, Outcome, SlotState, Taken, Visit

_ID = re.compile(r"[0-9A-Za-z-]{1,60}", re.ASCII)
Pair = tuple[str, str]


def row(session: Session, id: str) -> VisitRow:
    """The row of a visit; NotKept if there is none."""
    found = session.get(VisitRow, id) if _ID.fullmatch(id) else None
    if found is None:
        raise NotKept("this visit is not kept here", "Choose the person from the list.")
    return found


def consent(session: Session, id: str) -> tuple[str, str | None]:
    """The person's number and the recorded answer to the question of consent; NotKept if there is no such visit."""
    person = row(session, id).person
    answer = session.get(FieldRow, (id, "consent"))
    return person, None if answer is None else json.loads(answer.value)


def found(session: Session, limit: int, day: str | None, open: bool | None, digits: str | None) -> list[VisitRow]:
    """The newest rows, newest first, that fit all that is asked."""
    query = select(VisitRow).order_by(VisitRow.begun_at.desc(), VisitRow.id.desc()).limit(limit)
    if day is not None:
        query = query.where(VisitRow.day == day)
    if open is not None:
        query = query.where(VisitRow.finished_at.is_(None) if open else VisitRow.finished_at.is_not(None))
    if digits:
        query = query.where(func.instr(VisitRow.person, digits.upper()) > 0)
    return list(session.scalars(query))


def counts(session: Session, day: str | None) -> dict[str, int]:
    """How many visits of a day (None: of all) are done, are to be finished, and were referred."""
    code = func.json_extract(VisitRow.outcome, "$.code")
    query = select(
        func.count(VisitRow.finished_at), func.count(), func.count(case((code.like("refer%"), 1)))
    ).select_from(VisitRow)
    done, every, referred = session.execute(query if day is None else query.where(VisitRow.day == day)).one()
    return {"done": done, "to_finish": every - done, "referred": referred}


def read(session: Session, protocol: Protocol, rows: Sequence[VisitRow]) -> list[Visit]:
    """The visits of these rows, in their order."""
    ids, fields = [row.id for row in rows], _fields(session, rows)
    taken, decided = _taken(session, ids), _decided(session, ids)
    return [
        Visit(
            row.id, row.person, row.day, datetime.fromisoformat(row.begun_at), fields[row.id],
            {
                slot.id: SlotState(tuple(taken[row.id, slot.id]), decided.get((row.id, slot.id)))
                for slot in protocol.slots
            },
            None if row.finished_at is None else datetime.fromisoformat(row.finished_at),
            None if row.outcome is None else Outcome(**json.loads(row.outcome)),
        )
        for row in rows
    ]  # fmt: skip


def _fields(session: Session, rows: Sequence[VisitRow]) -> dict[str, dict[str, Any]]:
    """The answers of each visit, and what tells who its person is."""
    out: dict[str, dict[str, Any]] = {row.id: {} for row in rows}
    for field in session.scalars(select(FieldRow).where(FieldRow.visit.in_(out))):
        out[field.visit][field.name] = json.loads(field.value)
    known: dict[str, dict[str, Any]] = defaultdict(dict)
    for one in session.scalars(select(IdentifierRow).where(IdentifierRow.person.in_({row.person for row in rows}))):
        known[one.person][one.name] = json.loads(one.value)
    return {row.id: out[row.id] | known[row.person] for row in rows}


def _taken(session: Session, ids: Sequence[str]) -> dict[Pair, list[Taken]]:
    """The captures of each slot, oldest first, and what was thought of them."""
    verdict = func.json_extract(CaptureRow.report, "$.verdict")
    query = (
        select(ShotRow.visit, ShotRow.slot, ShotRow.capture, verdict)
        .join(CaptureRow, CaptureRow.id == ShotRow.capture)
        .where(ShotRow.visit.in_(ids))
        .order_by(KEPT)
    )
    out: dict[Pair, list[Taken]] = defaultdict(list)
    for visit, slot, capture, thought in session.execute(query):
        out[visit, slot].append(Taken(capture, None if thought is None else json.loads(thought)))
    return out


def _decided(session: Session, ids: Sequence[str]) -> dict[Pair, Decided]:
    query = select(SlotRow).where(SlotRow.visit.in_(ids))
    return {(row.visit, row.slot): Decided(row.capture, row.reason) for row in session.scalars(query)}
