"""What a technician asks about what happened lately: read it, save it as a file, copy it to a stick."""

from typing import Any

from fastapi import APIRouter, Query, Response
from pydantic import Field

from device.clock import Clock
from services.instrument.diary import Diary
from services.instrument.exporting import Sticks, copied
from services.instrument.technician_api import Body


class Away(Body):
    """The stick it goes to, as the page was told of it."""

    folder: str = Field(max_length=400)


def diary_routes(diary: Diary, sticks: Sticks, clock: Clock) -> APIRouter:
    """Addresses under /api/technician/diary."""
    router = APIRouter(prefix="/api/technician")

    def name() -> str:
        return f"diary-{clock.wall():%Y-%m-%d}"

    @router.get("/diary")
    def entries(limit: int = Query(100, ge=1, le=1000), about: str | None = None) -> dict[str, Any]:
        """What the instrument logged, newest first; `about` a capture, or everything."""
        return {"entries": diary.entries(limit, about)}

    @router.get("/diary.txt", response_class=Response)
    def download() -> Response:
        """All of it as sentences, the oldest first."""
        headers = {"Content-Disposition": f'attachment; filename="{name()}.txt"'}
        return Response(diary.told(), media_type="text/plain; charset=utf-8", headers=headers)

    @router.post("/diary/export")
    def copy(away: Away) -> dict[str, str]:
        """Copy it to a stick, as sentences and as it is kept; the answer names the new folder."""
        files = {"diary.txt": diary.told(), "diary.jsonl": diary.kept()}
        return {"folder": copied(sticks.chosen(away.folder), name(), files).name}

    return router
