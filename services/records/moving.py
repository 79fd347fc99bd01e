"""A picture that was taken of the other eye than was said: it goes to that eye's slot, and says so ever after."""

import json
from datetime import datetime
from typing import Any

from sqlalchemy.orm import Session

from device.errors import InputError, NotKept
from device.values import Eye
from services.records import schema
from services.records.protocol import CHOOSE, Protocol, Slot
from services.records.schema import CaptureRow, ShotRow


def place_of(session: Session, capture: str) -> ShotRow:
    """Where a capture stands; NotKept if it belongs to no visit."""
    shot = session.get(ShotRow, capture)
    if shot is None:
        raise NotKept("this picture belongs to no person")
    return shot


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
    capture stay as they were made.
    """
    row = session.get_one(CaptureRow, shot.capture)
    report: dict[str, Any] = json.loads(row.report)
    told = {"from_eye": row.eye, "from_slot": shot.slot, "eye": to.eye, "at": at.isoformat(), "by": by}
    report |= {"slot": to.id, "moved": [*report.get("moved", []), told]}
    row.eye, row.report, shot.slot = to.eye, schema.report_text(report), to.id
