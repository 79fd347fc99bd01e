"""The HTTP face of the instrument: what DESIGN.md fixes, errors in one table, and the page itself."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Header, Query, Request, Response
from fastapi import Path as InPath
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, ConfigDict, Field
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import web
from device.errors import (
    BusFault,
    Busy,
    CalibrationDamaged,
    CalibrationMissing,
    CalibrationOld,
    CalibrationOtherMode,
    CalibrationRefused,
    CalibrationStale,
    CameraMissing,
    CameraPacked,
    CameraStalled,
    CameraWrong,
    DiffuscopeError,
    HeadMismatch,
    InputError,
    LightFault,
    LightLimit,
    NotKept,
    PowerLow,
    StoreDamaged,
    StoreError,
    StoreFull,
    TooHot,
)  # fmt: skip
from device.recon.model import field_radius_px
from device.values import Capture, Eye
from services.health.checks import judged
from services.health.probe import as_json
from services.instrument.exam import Exam
from services.instrument.wellbeing import facts

STATUS: dict[type[DiffuscopeError], int] = {
    NotKept: 404,
    Busy: 409,
    InputError: 422,
    LightLimit: 423,
    LightFault: 423,
    CameraMissing: 503,
    CameraStalled: 503,
    CameraWrong: 503,
    CameraPacked: 503,
    BusFault: 503,
    HeadMismatch: 423,
    TooHot: 423,
    PowerLow: 423,
    CalibrationMissing: 423,
    CalibrationRefused: 423,
    CalibrationDamaged: 423,
    CalibrationOld: 423,
    CalibrationStale: 423,
    CalibrationOtherMode: 423,
    StoreFull: 507,
    StoreDamaged: 500,
    DiffuscopeError: 500,
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types lit-html"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}
MEDIA = {".png": "image/png", ".jpg": "image/jpeg", ".tiff": "image/tiff", ".json": "application/json"}
LARGEST_BODY_BYTES = 10_000


class Refusal(BaseModel):
    """Why something was not done: a code for the log, what happened, and what to do, in plain words."""

    code: str
    message: str
    remedy: str


class Press(BaseModel):
    """What the button sends: which eye, and a key that makes a repeated request the same press."""

    model_config = ConfigDict(extra="forbid")
    eye: Eye
    key: str | None = Field(default=None, pattern="^[0-9a-f]{16}$")


def create_app(exam: Exam) -> FastAPI:
    """The application around one exam."""

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        yield
        exam.bulletin.close()

    app = FastAPI(
        title="Diffuscope", version=version("diffuscope"), lifespan=life, openapi_url="/api/openapi.json",
        docs_url=None, redoc_url=None, responses={"4XX": {"model": Refusal}, "5XX": {"model": Refusal}},
    )  # fmt: skip
    _words_for_errors(app)
    app.add_middleware(SafeHeaders)
    _captures(app, exam)
    _state(app, exam)
    _live(app, exam)
    _page(app)
    return app


def refusal(error: DiffuscopeError) -> JSONResponse:
    """An error as the page wants it: code, message, remedy, and the status of its class or its nearest ancestor."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    return JSONResponse(words(error), status)


def words(error: DiffuscopeError) -> dict[str, str]:
    """What happened and what to do, as the page shows it."""
    return {"code": error.code, "message": error.message, "remedy": error.remedy}


def _words_for_errors(app: FastAPI) -> None:
    @app.exception_handler(DiffuscopeError)
    async def _(_: Request, error: DiffuscopeError) -> JSONResponse:
        return refusal(error)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return refusal(InputError(f"{where}: {first['msg']}", "Reload the page and try again."))

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> JSONResponse:
        message = f"{request.method} {request.url.path}: {error.detail}"
        answer = Refusal(code=f"http.{error.status_code}", message=message, remedy="Go back to the page.")
        return JSONResponse(answer.model_dump(), error.status_code, error.headers)

    @app.exception_handler(Exception)  # answered outside every middleware, and then logged by the server
    async def _(request: Request, _: Exception) -> JSONResponse:
        answer = refusal(DiffuscopeError("something happened that nobody foresaw"))
        answer.headers.update(rules(request.url.path))
        return answer


def rules(path: str) -> dict[str, str]:
    """The page's rules for its browser, and whether an answer may be kept."""
    return HEADERS | {"Cache-Control": "no-store" if path.startswith("/api/") else "no-cache"}


class SafeHeaders:
    """Puts the page's rules on every answer, and refuses bodies that no button sends; streams pass untouched."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(rules(scope["path"]))
            await send(message)

        app = _TOO_LARGE if _is_too_large(Headers(scope=scope)) else self.app
        await app(scope, receive, with_headers)


_TOO_LARGE = refusal(InputError("this request is too large", "Reload the page and try again."))


def _is_too_large(headers: Headers) -> bool:
    """Whether a body is larger than a button sends, or does not say how large it is."""
    length = headers.get("content-length") or "0"
    return "transfer-encoding" in headers or not length.isdecimal() or int(length) > LARGEST_BODY_BYTES


def shown(capture: Capture) -> dict[str, Any]:
    """A capture as JSON, with the addresses of its files."""
    at = f"/api/captures/{capture.id}"
    return {
        "id": capture.id, "eye": capture.eye, "taken_at": capture.taken_at.isoformat(),
        "simulated": capture.simulated, "calibration_id": capture.calibration_id, "report": capture.report,
        "files": capture.files,
        "links": {
            "picture": f"{at}/picture.png", "raw": f"{at}/raw.tiff", "report": f"{at}/report.json",
            "quick": f"{at}/quick.jpg",
        },
    }  # fmt: skip


def _captures(app: FastAPI, exam: Exam) -> None:
    store = exam.store

    @app.post("/api/captures", status_code=201)
    async def press(press: Press) -> dict[str, Any]:
        """Take one picture and keep it."""
        return shown(await asyncio.wrap_future(exam.press(press.eye, press.key)))

    @app.get("/api/captures")
    def captures(limit: int = Query(50, ge=1, le=500), before: str | None = None) -> dict[str, Any]:
        """The newest captures, newest first."""
        return {"captures": [shown(capture) for capture in store.captures(limit, before)]}

    @app.get("/api/captures/{id}")
    def capture(id: str) -> dict[str, Any]:
        """One capture."""
        return shown(store.get(id))

    @app.get("/api/captures/{id}/{name}")
    def file(id: str, name: str = InPath(pattern="^[a-z]+[.](png|jpg|tiff|json)$")) -> Response:
        """One file of a capture, or the quick look of the one that is being made."""
        quick = exam.quick(id) if name == "quick.jpg" else None
        content = quick if quick is not None else store.read(id, name)
        return Response(content, media_type=MEDIA[Path(name).suffix])


def _state(app: FastAPI, exam: Exam) -> None:
    @app.get("/api/status")
    def status() -> dict[str, Any]:
        """What this instrument is and does now."""
        head, problem = exam.head, exam.problem
        radius_px = field_radius_px(head.calibration)
        return {
            "name": head.spec.name, "kind": head.kind, "state": exam.state, "shape": head.camera.shape,
            "field_px": 2 * radius_px if radius_px < float("inf") else None, "version": app.version,
            "swept": exam.store.swept, "space_left": exam.store.space_left(),
            "problem": words(problem) if problem else None,
        }  # fmt: skip

    @app.get("/api/health")
    def health() -> dict[str, Any]:
        """Whether it can take pictures now: every check with its value, its limit and what to do."""
        known = facts(exam)
        checks = judged(known)
        return {
            "ok": all(check.ok for check in checks), "state": known.state, "space_left": known.captures_left,
            "battery": known.battery if isinstance(known.battery, float) else None, "checks": as_json(checks),
        }  # fmt: skip


def _live(app: FastAPI, exam: Exam) -> None:
    @app.get("/api/preview")
    def preview(after: int = Query(0, ge=0)) -> Response:
        """The next live picture after number `after`; 204 when none comes in 2 s."""
        live = exam.preview(after)
        if live is None:
            return Response(status_code=204)
        age_ms = max(0, round((exam.clock.now_s() - live.exposed_s) * 1000))
        return Response(
            live.jpeg, media_type="image/jpeg", headers={"X-Frame": str(live.number), "X-Age-Ms": str(age_ms)}
        )

    @app.get("/api/events")
    async def events(last_event_id: int | None = Header(None, ge=0)) -> StreamingResponse:
        """What happens, as server-sent events, with a heartbeat every second."""

        async def lines() -> AsyncIterator[str]:
            async for event in exam.bulletin.follow(last_event_id):
                if event.kind == "kept":
                    if (capture := _still_kept(exam, event.data["id"])) is None:
                        continue
                    event = replace(event, data=shown(capture))
                yield event.as_sse()

        return StreamingResponse(lines(), media_type="text/event-stream")


def _still_kept(exam: Exam, id: str) -> Capture | None:
    """A kept capture; None if it has been damaged since, because the news after it must arrive all the same."""
    try:
        return exam.store.get(id)
    except StoreError:
        return None


def _page(app: FastAPI) -> None:
    folder = Path(web.__file__).parent

    @app.get("/", include_in_schema=False)
    def index() -> FileResponse:
        return FileResponse(folder / "index.html")

    app.mount("/web", StaticFiles(directory=folder))
