"""What a page sees and hears while it is open: the live pictures, and everything that happens."""

import json
from collections.abc import AsyncIterator, Callable
from dataclasses import asdict, replace
from typing import Any

from fastapi import FastAPI, Header, Query, Response
from fastapi.responses import StreamingResponse

from device.errors import StoreError
from device.values import EYES, Capture, Eye
from services.instrument.owner import Owner
from services.instrument.press import LiveRequest
from services.instrument.visits_api import NAME
from services.records.people import People
from services.records.store import Store


def live_routes(app: FastAPI, owner: Owner, people: People, shown: Callable[[Capture], dict[str, Any]]) -> None:
    """What goes on while a page is open; `shown` is a capture as JSON."""
    _preview(app, owner, people)
    _events(app, owner, shown)


def _preview(app: FastAPI, owner: Owner, people: People) -> None:
    @app.get("/api/preview")
    def preview(
        after: int = Query(0, ge=0), eye: Eye | None = None, visit: str | None = Query(None, pattern=NAME)
    ) -> Response:
        """The next live picture after number `after`, of that eye if it is known; 204 when none comes in 2 s.

        For a visit only while its consent is `agreed`: else 409, and the lamp stays dark. Without one, for a test
        picture.

        It makes the lamp shine, so no page but the instrument's own may ask: browsers say so themselves
        (`Sec-Fetch-Site`), and everybody else gives any `X-Controller`, which no foreign page can.
        """
        wanted = LiveRequest(EYES if eye is None else (eye,), people.permission(visit))
        wanted.permit()
        live = owner.preview(after, wanted)
        if live is None:
            return Response(status_code=204)
        age_ms = max(0, round((owner.house.clock.now_s() - live.exposed_s) * 1000))
        told = {"X-Frame": str(live.number), "X-Age-Ms": str(age_ms), "X-Aim": json.dumps(asdict(live.aim))}
        return Response(live.jpeg, media_type="image/jpeg", headers=told)


def _events(app: FastAPI, owner: Owner, shown: Callable[[Capture], dict[str, Any]]) -> None:
    @app.get("/api/events")
    async def events(last_event_id: int | None = Header(None, ge=0)) -> StreamingResponse:
        """What happens, as server-sent events, with a heartbeat (`beat`) every second.

        `state` (what the instrument does), `aim` (what to do so that a picture can be taken), `stage` (how far a
        picture is: `fraction`, `left_s`), `verdict`, `kept` (a capture), `failed` (`code`, `message`, `remedy`), and
        `notice`: a state of the page by its `code` stands from now on, with the numbers of its words (`n`, `date`,
        `wait_s`), or is over (`over`). What stands already is in the status. `calibration` is news of its findings.
        """

        async def lines() -> AsyncIterator[str]:
            async for event in owner.house.bulletin.follow(last_event_id):
                if event.kind == "kept":
                    if (capture := _still_kept(owner.house.store, event.data["id"])) is None:
                        continue
                    event = replace(event, data=shown(capture))
                yield event.as_sse()

        return StreamingResponse(lines(), media_type="text/event-stream")


def _still_kept(store: Store, id: str) -> Capture | None:
    """A kept capture; None if it has been damaged since, because the news after it must arrive all the same."""
    try:
        return store.get(id)
    except StoreError:
        return None
