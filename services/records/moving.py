"""A picture that was taken of the other eye than was said: it goes to that eye's slot, and says so ever after.

Or somebody says that its eye is the right one: then nobody asks again.
"""

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from device.errors import InputError, NotKept
from device.values import Eye
from services.records import schema
from services.records.light_book import count_also
from services.records.protocol import CHOOSE, Protocol, Slot
from services.records.schema import CaptureRow, ShotRow, VisitRow

ASKED = 8  # of that many captures, the newest: more than a visit has
OTHER: dict[str, Eye] = {"OD": "OS", "OS": "OD"}


@dataclass(frozen=True)
class Question:
    """A capture that seems to be of the other eye, and stands in that slot."""

    id: str
    slot: str
    other: Eye


def question(session: Session) -> Question | None:
    """The newest capture of an open visit that seems to be of the other eye, while nobody said which it is of."""
    newest = select(CaptureRow.id).order_by(schema.KEPT.desc()).limit(ASKED)
    seen, moved, confirmed = (
        func.json_extract(CaptureRow.report, f"$.{path}") for path in ("laterality.eye", "moved", "confirmed")
    )
    found = session.execute(
        select(CaptureRow.id, CaptureRow.eye, ShotRow.slot)
        .join(ShotRow, ShotRow.capture == CaptureRow.id)
        .join(VisitRow, VisitRow.id == ShotRow.visit)
        .where(CaptureRow.id.in_(newest), VisitRow.finished_at.is_(None))
        .where(seen.is_not(None), seen != CaptureRow.eye, moved.is_(None), confirmed.is_(None))
        .order_by(schema.KEPT.desc())
    ).first()
    return None if found is None else Question(found.id, found.slot, OTHER[found.eye])


def place_of(session: Session, capture: str) -> ShotRow:
    """Where a capture stands; NotKept if there is none of that name, or if it is a test picture, which stays one."""
    shot = session.get(ShotRow, capture)
    if shot is not None:
        return shot
    if session.get(CaptureRow, capture) is None:
        raise NotKept(f"there is no capture named {capture!r}")
    raise NotKept("this is a test picture: it belongs to no person", "Take the picture again for this person.")


def same_field(protocol: Protocol, slot: str, eye: Eye) -> Slot:
    """The slot of that eye which looks at the same part; InputError if the programme has none."""
    field = protocol.slot(slot).field
    for one in protocol.slots:
        if (one.eye, one.field) == (eye, field):
            return one
    raise InputError(f"eye: the programme has no picture of the {field} of {eye}", CHOOSE)


def relabel(session: Session, shot: ShotRow, to: Slot, at: datetime, by: str | None) -> None:
    """Write the new eye and slot into the record, and into its report who moved it, when, and from where.

    `by` is the public name of the screen that asked; None: the instrument's own button, or a script. The files of the
    capture stay as they were made. Its light counts for the new eye too, once, and goes on counting for the others:
    a tap is no proof.
    """
    row = session.get_one(CaptureRow, shot.capture)
    report: dict[str, Any] = json.loads(row.report)
    told = {"from_eye": row.eye, "from_slot": shot.slot, "eye": to.eye, "at": at.isoformat(), "by": by}
    report |= {"slot": to.id, "moved": [*report.get("moved", []), told]}
    counted = {row.eye, *(one["from_eye"] for one in report["moved"])}
    if to.eye not in counted:
        count_also(session, to.eye, report.get("dose_j_per_cm2", 0.0))
    row.eye, row.report, shot.slot = to.eye, schema.report_text(report), to.id


def confirm(session: Session, shot: ShotRow, at: datetime, by: str | None) -> None:
    """Write into a capture's report that its eye is the right one; `by` as in `relabel`."""
    row = session.get_one(CaptureRow, shot.capture)
    report: dict[str, Any] = json.loads(row.report)
    row.report = schema.report_text(report | {"confirmed": {"eye": row.eye, "at": at.isoformat(), "by": by}})
