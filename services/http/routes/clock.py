"""Endpoints of the clock: the time of a tablet, which a user accepts for a device without a time."""

from pathlib import Path

from fastapi import APIRouter, Request

from device.clock import Clock
from services.health.clock_request import request_time
from services.http.schemas.clock import ClockAnswer, ClockTime


def clock_router(clock: Clock, root: Path) -> APIRouter:
    """Return the router of the clock; `root` is the root of the file system."""
    router = APIRouter()

    @router.post("/api/clock")
    def accept(accepted: ClockTime, request: Request) -> ClockAnswer:
        """Set the clock of a device without a time to that of a tablet, which its user has read and accepted.

        Later records have the source `browser`: the time was not verified. 409 if the clock has a source, or for a time
        before that of the device.
        """
        return requested(accepted, request, by_administrator=False)

    @router.post("/api/clock/back")
    def set_back(accepted: ClockTime, request: Request) -> ClockAnswer:
        """Set the clock to the time of a tablet as an administrator, also backwards or once more.

        409 if the network or a clock cell has set it.
        """
        return requested(accepted, request, by_administrator=True)

    def requested(accepted: ClockTime, request: Request, by_administrator: bool) -> ClockAnswer:
        was = clock.wall()
        request.state.audit_field = f"{was.isoformat()} {accepted.now.isoformat()}"
        request_time(accepted.now, clock, by_administrator, root)
        return ClockAnswer(was=was, now=accepted.now)

    return router
