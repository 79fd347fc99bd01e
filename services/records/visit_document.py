"""Visit as a JSON object: the same on the wire, in exports and in uploads."""

from datetime import datetime
from typing import Literal

from pydantic import BaseModel, ConfigDict

from services.records.capture import StoredVerdict
from services.records.json_values import FormValue, Timestamp
from services.records.visit import Outcome, ReopenReason, SlotState, Visit


class SlotDocument(BaseModel):
    """One picture slot of a visit: the chosen capture with its verdict, all captures, and the number of attempts.

    `reason`: why a picture is not possible, or null.
    """

    model_config = ConfigDict(frozen=True)

    state: Literal["empty", "taken", "not_possible"]
    capture: str | None
    captures: list[str]
    verdict: StoredVerdict | None
    reason: str | None
    tries: int


class VisitDocument(BaseModel):
    """A visit with its form fields and picture slots; `day` is the local date.

    `next_slot`: first empty slot, or null. `outcome`, `finished_at`: null until the visit is finished. `undo_until`:
    time until which the finish can be undone, or null. `no_colour`: code of the reason why the pictures are shown in
    green light; null if all are in colour.
    """

    model_config = ConfigDict(frozen=True)

    id: str
    number: str
    begun_at: Timestamp
    day: str
    fields: dict[str, FormValue]
    slots: dict[str, SlotDocument]
    next_slot: str | None
    no_colour: str | None
    outcome: Outcome | None
    finished_at: Timestamp | None
    undo_until: Timestamp | None


class VisitChange(BaseModel):
    """One change of a visit: time by the device's clock, user ("" for the device), form field, `outcome`, `laterality`.

    `was`, `value`: before and after; an outcome by its code, a laterality by its picture slot. `why`: reason of a
    reopening, or null.
    """

    model_config = ConfigDict(frozen=True)

    number: int
    at: Timestamp
    user: str
    field: str
    was: FormValue
    value: FormValue
    why: ReopenReason | None


class ChangeList(BaseModel):
    """History of a visit, the first change first."""

    model_config = ConfigDict(frozen=True)

    changes: list[VisitChange]


def visit_document(visit: Visit, undo_until: datetime | None = None) -> VisitDocument:
    """Return the document of a visit, with identifying fields; ValueError for an answer of an impossible type."""
    return VisitDocument(
        id=visit.id,
        number=visit.number,
        begun_at=visit.begun_at,
        day=visit.day,
        fields=dict(visit.fields),
        slots={id: _slot_document(slot) for id, slot in visit.slots.items()},
        next_slot=visit.next_slot,
        no_colour=visit.no_colour,
        outcome=visit.outcome,
        finished_at=visit.finished_at,
        undo_until=undo_until,
    )


def _slot_document(slot: SlotState) -> SlotDocument:
    chosen = slot.chosen
    return SlotDocument(
        state=slot.state,
        capture=chosen.capture if chosen else None,
        captures=[taken.capture for taken in slot.captures],
        verdict=chosen.verdict if chosen else None,
        reason=slot.decision.reason if slot.decision else None,
        tries=len(slot.captures),
    )
