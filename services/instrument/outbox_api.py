"""The addresses of the Send screen: who waits to be sent and why, and try now."""

from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import Field

from device.errors import DiffuscopeError, NotKept, SendError, SendOff, StoreDamaged
from services.instrument.sending import Sender
from services.instrument.visits_api import NAME, Order
from services.records.outbox import Waiting

LISTED = 200
KINDS: tuple[type[DiffuscopeError], ...] = (*SendError.__subclasses__(), StoreDamaged, NotKept)
REMEDIES = {kind.code: kind.default_remedy for kind in KINDS}


class TryNow(Order):
    """Try to send one visit at once; without one, all."""

    visit: Annotated[str, Field(pattern=NAME)] | None = None


def outbox_router(sender: Sender | None) -> APIRouter:
    """What there is to ask about sending; without a `sender` nothing is sent from here, and it says so."""
    router = APIRouter()

    @router.get("/api/outbox")
    def outbox() -> dict[str, Any]:
        """Who waits to be sent, the longest first, and when it is tried next."""
        return shown_outbox(sender)

    @router.post("/api/outbox/try")
    def try_now(order: TryNow) -> dict[str, Any]:
        """Try at once."""
        if sender is None:
            raise SendOff("no receiver is set up")
        sender.try_now(order.visit)
        return shown_outbox(sender)

    return router


def shown_outbox(sender: Sender | None) -> dict[str, Any]:
    """The outbox as JSON."""
    if sender is None:
        return {"configured": False, "sent": 0, "waiting": 0, "next_try_s": 0.0, "visits": []}
    visits = [_shown(one) for one in sender.outbox.waiting(LISTED, sizes=True)]
    return {"configured": True, **sender.counts(), "next_try_s": round(sender.wait_s, 1), "visits": visits}


def _shown(one: Waiting) -> dict[str, Any]:
    error = {"code": one.error, "message": one.said, "remedy": REMEDIES.get(one.error, "")} if one.error else None
    return {
        "visit": one.visit, "number": one.number, "since": one.finished_at.isoformat(), "size_bytes": one.size_bytes,
        "tries": one.tries, "failing_since": one.failing_since.isoformat() if one.failing_since else None,
        "error": error, "stuck": one.stuck,
    }  # fmt: skip
