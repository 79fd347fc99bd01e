"""Endpoint of the server-sent events: a stream from the event bus to the page."""

from collections.abc import AsyncIterator

from fastapi import APIRouter, Header, Request
from pydantic_core import to_json

from device.errors import StoreError
from services.http.access import may
from services.http.media import EventStream
from services.http.schemas.captures import CaptureAnswer, capture_answer
from services.http.schemas.events import SERVER_SENT_EVENT, ServerSentEvent
from services.instrument.events import Event
from services.instrument.head_arbiter import HeadArbiter
from services.records.capture_store import CaptureStore


def event_router(arbiter: HeadArbiter) -> APIRouter:
    """Return the router of the events."""
    router = APIRouter()

    @router.get("/api/events", response_class=EventStream, responses={200: {"model": ServerSentEvent}})
    async def events(request: Request, last_event_id: int | None = Header(None, ge=0)) -> EventStream:
        """Stream server-sent events, with a heartbeat (`beat`) every second.

        `state`: state of the instrument. `aim`: aiming hint. `button`: the button on the handle was pressed. `stage`:
        progress of a capture (`fraction` 0 to 1, seconds `left_s`). `verdict`: image quality of a capture. `kept`: a
        stored capture. `failed`: an error (`code`, `message`, `remedy`). `accuracy`: progress of the accuracy explorer.
        `notice`: an alert, by its `code`, is active from now on, with its values (`n`, `date`, `wait_s`), or ended
        (`over`); alerts that are active already are part of the status. `calibration`: new findings of the calibration
        monitor. With `Last-Event-ID` the stream resumes after that event. Events with the id of a capture come to users
        who may read captures. The stream ends with the login. 503 if too many streams are open.
        """

        async def lines() -> AsyncIterator[str]:
            async for event in arbiter.context.event_bus.subscribe(last_event_id):
                if not may(request, "GET /api/events"):
                    return
                if "id" in event.data and not may(request, "GET /api/captures/{id}"):
                    continue
                if event.kind != "kept":
                    yield sse_text(event)
                elif (capture := _readable(arbiter.context.store, str(event.data["id"]))) is not None:
                    yield sse_text(event, capture)

        return EventStream(lines())

    return router


def sse_text(event: Event, capture: CaptureAnswer | None = None) -> str:
    """Return an event in the text format of server-sent events; a heartbeat (number 0) gets no id.

    `capture` is the payload of an event `kept`. ValidationError for an unknown event or another payload.
    """
    payload = SERVER_SENT_EVENT.validate_python({"event": event.kind, "data": capture or event.data}).data
    mark = f"id: {event.number}\n" if event.number else ""
    return f"{mark}event: {event.kind}\ndata: {to_json(payload).decode()}\n\n"


def _readable(store: CaptureStore, id: str) -> CaptureAnswer | None:
    """Return a stored capture; None if it cannot be read, so that the stream continues with the next event."""
    try:
        return capture_answer(store.get(id))
    except StoreError:
        return None
