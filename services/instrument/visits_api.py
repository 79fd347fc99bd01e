"""The addresses of persons and visits: what a page asks of the shelf, in the page's own words."""

from collections.abc import Callable
from datetime import date
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from device.values import Eye
from services.instrument.exporting import Sticks, copied, exported, folder_name, zipped
from services.instrument.lease import Lease
from services.instrument.promised import Promised
from services.records.people import People
from services.records.store import Store
from services.records.visit import SlotState, Visit

KEY = "^[0-9a-f]{16}$"
NAME = "^[A-Za-z0-9._-]{1,128}$"
Key = Annotated[str, Field(pattern=KEY)]
CaptureName = Annotated[str, Field(pattern=NAME)]
SlotName = Annotated[str, Field(min_length=1, max_length=40)]


class Order(BaseModel):
    """A request that changes something; its key makes a repetition harmless."""

    model_config = ConfigDict(extra="forbid")
    key: Key


class Begin(Order):
    """A new visit: of a known number, of a new one, or of the next automatic one."""

    number: str | None = Field(default=None, min_length=1, max_length=40)


class Answered(Order):
    """One answer; null takes it back."""

    field: str = Field(min_length=1, max_length=40)
    value: str | int | bool | list[str] | None


class CouldNot(Order):
    """A picture that could not be taken, and why."""

    slot: SlotName
    reason: str = Field(min_length=1, max_length=40)


class Chosen(Order):
    """The capture that stands for a slot; null empties it."""

    slot: SlotName
    capture: CaptureName | None


class OfEye(Order):
    """Which eye a picture was really of."""

    eye: Eye


class Away(Order):
    """A stick to copy a visit to."""

    folder: str = Field(min_length=1, max_length=1000)


class Asking(Order):
    """A screen that wants to take pictures; `take`: even if another does; `release`: it closes, and wants no more."""

    take: bool = False
    release: bool = False


def visits_router(people: People, lease: Lease, promised: Promised, finished: Callable[[], None]) -> APIRouter:
    """What there is to ask about persons and visits; `finished` hears of each finish."""
    router = APIRouter()
    _reading(router, people)
    _changing(router, people, promised, finished)

    @router.post("/api/captures/{id}/eye")
    def move(id: str, order: OfEye) -> dict[str, Any]:
        """This picture is of that eye: it goes to that eye's slot of the same part, if it is not there already.

        Its report says so, and nobody asks again which eye it shows.
        """
        return shown_visit(people.move(order.key, id, order.eye, lease.holder), people)

    @router.post("/api/controller")
    def controller(asking: Asking) -> dict[str, Any]:
        """Ask for the right to take pictures, take it from another screen, or let it go."""
        held = lease.release(asking.key) if asking.release else lease.ask(asking.key, asking.take)
        return {"lease": held.lease, "mine": held.mine}

    return router


def _reading(router: APIRouter, people: People) -> None:
    @router.get("/api/protocol")
    def protocol() -> dict[str, Any]:
        """Which pictures a visit should have, and the programme's own numbers."""
        return people.protocol.model_dump(mode="json")

    @router.get("/api/visits")
    def visits(
        day: date | None = None,
        open: bool | None = None,
        q: str | None = Query(None, max_length=20, pattern="^[0-9A-Za-z-]*$"),
        limit: int = Query(50, ge=1, le=500),
    ) -> dict[str, Any]:
        """The newest visits, newest first, and how many there are of that day (or of all)."""
        on = day.isoformat() if day else None
        return {
            "visits": [shown_visit(visit, people) for visit in people.visits(limit, on, open, q)],
            "counts": people.counts(on),
        }

    @router.get("/api/visits/{id}")
    def visit(id: str) -> dict[str, Any]:
        """One visit."""
        return shown_visit(people.get(id), people)


def _changing(router: APIRouter, people: People, promised: Promised, finished: Callable[[], None]) -> None:
    @router.post("/api/visits", status_code=201)
    def begin(order: Begin) -> dict[str, Any]:
        """Begin a visit; without a number, of somebody new with the next one."""
        return shown_visit(people.begin(order.key, order.number), people)

    @router.patch("/api/visits/{id}")
    def answer(id: str, order: Answered) -> dict[str, Any]:
        """Write one answer down."""
        return shown_visit(people.answer(order.key, id, order.field, order.value), people)

    @router.post("/api/visits/{id}/could-not")
    def could_not(id: str, order: CouldNot) -> dict[str, Any]:
        """A picture could not be taken."""
        return shown_visit(people.could_not(order.key, id, order.slot, order.reason), people)

    @router.post("/api/visits/{id}/slots")
    def choose(id: str, order: Chosen) -> dict[str, Any]:
        """Let a capture stand for a slot, or empty it."""
        return shown_visit(people.choose(order.key, id, order.slot, order.capture), people)

    @router.post("/api/captures/{id}/keep")
    def keep(id: str, order: Order) -> dict[str, Any]:
        """Let this capture stand for its slot."""
        return shown_visit(people.keep(order.key, id), people)

    @router.post("/api/visits/{id}/finish")
    def finish(id: str, order: Order) -> dict[str, Any]:
        """Finish with what there is, once no picture of it is being made any more; the answer has the outcome."""
        promised.wait(id)
        visit = people.finish(order.key, id)
        finished()
        return shown_visit(visit, people)

    @router.post("/api/visits/{id}/reopen")
    def reopen(id: str, order: Order) -> dict[str, Any]:
        """Undo a finish, on the same day."""
        return shown_visit(people.reopen(order.key, id), people)


def exports_router(people: People, store: Store, sticks: Sticks) -> APIRouter:
    """Ways to take a visit away."""
    router = APIRouter()

    @router.get("/api/exports")
    def exports() -> dict[str, Any]:
        """The USB sticks that are there now."""
        return {
            "folders": [
                {"id": str(stick.folder), "name": stick.folder.name, "free_bytes": stick.free_bytes}
                for stick in sticks.present()
            ]
        }

    @router.get("/api/visits/{id}/export.zip", response_class=Response)
    def download(id: str) -> Response:
        """A visit as one file."""
        visit = people.get(id)
        name = folder_name(visit)
        content = zipped(name, exported(store, visit, shown_visit(visit, people)), visit.begun_at)
        return Response(
            content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}.zip"'}
        )

    @router.post("/api/visits/{id}/export")
    def copy(id: str, order: Away) -> dict[str, str]:
        """Copy a visit to a stick; the answer names the new folder."""
        visit = people.get(id)

        def act() -> str:
            files = exported(store, visit, shown_visit(visit, people))
            return str(copied(sticks.chosen(order.folder), folder_name(visit), files))

        return {"folder": people.once(order.key, f"export {id} {order.folder}", act)}

    return router


def shown_visit(visit: Visit, people: People) -> dict[str, Any]:
    """A visit as JSON."""
    finished, ending = visit.finished_at, visit.outcome
    undo_until = people.undo_until(finished) if finished else None
    return {
        "id": visit.id, "number": visit.number, "begun_at": visit.begun_at.isoformat(), "day": visit.day,
        "fields": dict(visit.fields), "slots": {id: _shown_slot(slot) for id, slot in visit.slots.items()},
        "next_slot": visit.next_slot,
        "outcome": {"code": ending.code, "sentence": ending.sentence} if ending else None,
        "finished_at": finished.isoformat() if finished else None,
        "undo_until": undo_until.isoformat() if undo_until else None,
    }  # fmt: skip


def _shown_slot(slot: SlotState) -> dict[str, Any]:
    chosen = slot.chosen
    return {
        "state": slot.state, "capture": chosen.capture if chosen else None,
        "captures": [one.capture for one in slot.taken], "verdict": chosen.verdict if chosen else None,
        "reason": slot.decided.reason if slot.decided else None, "tries": len(slot.taken),
    }  # fmt: skip
