"""Endpoint of the live picture: the next live picture as JPEG, with number, age and aiming hint in headers."""

import json
from dataclasses import asdict

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from device.values import EYES, Eye
from services.http.access import require_light_role
from services.http.media import JpegResponse, file_responses, no_picture
from services.http.schemas.common import ID_PATTERN
from services.instrument.capture import LiveRequest
from services.instrument.head_arbiter import HeadArbiter
from services.records.visit_repository import VisitRepository

RESPONSES = file_responses("image/jpeg") | no_picture("no picture within 2 s")


def preview_router(arbiter: HeadArbiter, repository: VisitRepository) -> APIRouter:
    """Return the router of the live picture; the application adds the check of the control lease."""
    router = APIRouter()

    @router.get("/api/preview", response_class=JpegResponse, responses=RESPONSES)
    async def preview(
        request: Request,
        after: int = Query(0, ge=0),
        eye: Eye | None = None,
        visit: str | None = Query(None, pattern=ID_PATTERN),
    ) -> Response:
        """Return the next live picture with a number above `after`, as JPEG; the request turns the aiming light on.

        `eye`: the eye whose light dose is counted, by default both. Headers: `X-Frame` (picture number), `X-Age-Ms`,
        `X-Aim` (aiming hint, JSON). 204 if no picture arrives within 2 s. With `visit`, 409 unless its consent is
        `agreed`; the lamp stays off. Without it, the picture is a test picture of a technician, whose light has a lower
        limit. 409 while another screen holds the control lease; without `X-Controller`, while any screen does. CSRF
        protection: the request needs a same-origin `Sec-Fetch-Site` or any `X-Controller` header, else 403, since it
        turns the lamp on. 503 if too many requests wait at once.
        """
        require_light_role(request, visit)
        wanted = LiveRequest(EYES if eye is None else (eye,), repository.pictures.permission(visit), visit)
        await run_in_threadpool(wanted.permit)  # reads the database
        live = await arbiter.preview(after, wanted)
        if live is None:
            return Response(status_code=204)
        age_ms = max(0, round((arbiter.context.clock.now_s() - live.exposed_s) * 1000))
        headers = {"X-Frame": str(live.number), "X-Age-Ms": str(age_ms), "X-Aim": json.dumps(asdict(live.aim))}
        return JpegResponse(live.jpeg, headers=headers)

    return router
