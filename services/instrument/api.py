"""The HTTP face of the instrument: what DESIGN.md fixes, errors in one table, and the page itself."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Self

from fastapi import APIRouter, Depends, FastAPI, Header, Query, Request, Response
from fastapi import Path as InPath
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, model_validator
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device.errors import (
    BusFault,
    Busy,
    CalibrationDamaged,
    CalibrationFormat,
    CalibrationMissing,
    CalibrationOld,
    CalibrationOtherMode,
    CalibrationRefused,
    CalibrationStale,
    CalibrationStopped,
    CalibrationUntrusted,
    CameraMissing,
    CameraPacked,
    CameraStalled,
    CameraWrong,
    DiffuscopeError,
    Forged,
    HeadMismatch,
    InputError,
    LightFault,
    LightLimit,
    NotKept,
    OtherScreen,
    PinTooSoon,
    PinWrong,
    PowerLow,
    Refused,
    SendError,
    StickFull,
    StickGone,
    StoreDamaged,
    StoreFull,
    TechnicianLocked,
    TooHot,
    UpdateError,
    UpdateNoRoom,
    VisitFinished,
    WrongHost,
)  # fmt: skip
from device.head import kind_of
from device.recon.model import field_radius_px
from device.values import Capture, Eye
from services.health.checks import judged
from services.health.probe import as_json
from services.instrument.carrier import Carrier
from services.instrument.exporting import Sticks
from services.instrument.fitness import shown as shown_findings
from services.instrument.forgery import SAFE, OwnPageOnly, own_names
from services.instrument.lease import Lease
from services.instrument.live_api import live_routes
from services.instrument.notices import Notices, is_old
from services.instrument.outbox_api import outbox_router
from services.instrument.owner import Owner
from services.instrument.page import page
from services.instrument.promised import Promised
from services.instrument.sending import Sender, packer
from services.instrument.technician import Door
from services.instrument.technician_api import technician_routes
from services.instrument.updates_api import UPLOAD_PATH
from services.instrument.visits_api import NAME, exports_router, visits_router
from services.instrument.wellbeing import facts
from services.records.outbox import Outbox
from services.records.people import People
from services.records.protocol import Protocol, load_protocol

STATUS: dict[type[DiffuscopeError], int] = {
    NotKept: 404,
    Busy: 409,
    Refused: 409,
    OtherScreen: 409,
    VisitFinished: 409,
    Forged: 403,
    WrongHost: 400,
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
    CalibrationFormat: 423,
    CalibrationUntrusted: 423,
    CalibrationOld: 423,
    CalibrationStale: 423,
    CalibrationStopped: 423,
    CalibrationOtherMode: 423,
    TechnicianLocked: 401,
    PinWrong: 403,
    PinTooSoon: 429,
    StoreFull: 507,
    StickFull: 507,
    UpdateNoRoom: 507,
    UpdateError: 409,
    StickGone: 503,
    SendError: 409,
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
    """Why something was not done: a code for the log, what happened, and what to do, in plain words.

    `n` (minutes to wait) and `wait_s` are there where they are known.
    """

    code: str
    message: str
    remedy: str
    n: int | None = None
    wait_s: float | None = None


class Press(BaseModel):
    """What the button sends: which eye, for which slot, and a key that makes a repeated request the same press."""

    model_config = ConfigDict(extra="forbid")
    eye: Eye
    key: str | None = Field(default=None, pattern="^[0-9a-f]{16}$")
    visit: str | None = Field(default=None, pattern=NAME)
    slot: str | None = Field(default=None, min_length=1, max_length=40)

    @model_validator(mode="after")
    def _both_or_neither(self) -> Self:
        if (self.visit is None) != (self.slot is None):
            raise ValueError("give both the visit and the slot, or neither")
        return self


def create_app(
    owner: Owner, door: Door, protocol: Protocol | None = None, names: tuple[str, ...] | None = None,
    sticks: Sticks | None = None, rooms: Sequence[APIRouter] = (), carrier: Carrier | None = None,
) -> FastAPI:  # fmt: skip
    """The application around whoever has the head; it answers to these `names`, and to addresses and local ones.

    `rooms` are for the technician only; `carrier` is the way to a receiver, where there is one.
    """
    store, clock = owner.house.store, owner.house.clock
    people = People(store.engine, protocol or load_protocol(), clock)
    lease, promised = Lease(clock), Promised()
    outbox, pack = Outbox(store.engine, clock), packer(store, people)
    sender = Sender(outbox, pack, carrier, lambda: owner.is_idle, clock) if carrier is not None else None
    notices = Notices(owner, people, lease, sender)
    app = FastAPI(
        title="Diffuscope", version=version("diffuscope"), lifespan=_life(owner, notices),
        openapi_url="/api/openapi.json", docs_url=None, redoc_url=None,
        responses={"4XX": {"model": Refusal}, "5XX": {"model": Refusal}},
    )  # fmt: skip
    app.state.notices = notices
    _words_for_errors(app)
    app.add_middleware(OwnPageOnly, names=own_names() if names is None else names, answer=refusal)
    app.add_middleware(SafeHeaders)
    only_one = Depends(one_screen(lease))
    _captures(app, owner, people, promised, only_one)
    app.include_router(visits_router(people, lease, promised), dependencies=[only_one])
    app.include_router(exports_router(people, store, sticks or Sticks()), dependencies=[only_one])
    app.include_router(outbox_router(sender), dependencies=[only_one])
    _state(app, owner, people, notices)
    live_routes(app, owner, people, shown)
    technician_routes(app, owner, door, rooms)
    page(app)
    return app


def _life(owner: Owner, notices: Notices) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """What runs beside the server for as long as it runs."""

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        notices.begin()
        if notices.sender is not None:
            notices.sender.begin()
        yield
        if notices.sender is not None:
            notices.sender.close()
        notices.close()
        owner.house.bulletin.close()

    return life


def one_screen(lease: Lease) -> Callable[..., None]:
    """What every changing address asks first: whether another screen holds the camera; any request renews a lease."""

    def check(request: Request, x_controller: Annotated[str | None, Header(max_length=64)] = None) -> None:
        if request.method in SAFE or request.url.path == "/api/controller":
            lease.touch(x_controller or "")
        else:
            lease.check(x_controller)

    return check


def refusal(error: DiffuscopeError) -> JSONResponse:
    """An error as the page wants it: code, message, remedy, and the status of its class or its nearest ancestor."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    return JSONResponse(words(error), status)


def words(error: DiffuscopeError) -> dict[str, Any]:
    """What happened and what to do, as the page shows it."""
    return Refusal(
        code=error.code, message=error.message, remedy=error.remedy, n=error.n, wait_s=error.wait_s
    ).model_dump(exclude_none=True)


def _words_for_errors(app: FastAPI) -> None:
    @app.exception_handler(DiffuscopeError)
    async def _(_: Request, error: DiffuscopeError) -> JSONResponse:
        return refusal(error)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        said = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        plain = said.encode("utf-8", "replace").decode()  # half a character cannot be sent back
        return refusal(InputError(plain, "Reload the page and try again."))

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> JSONResponse:
        message = f"{request.method} {request.url.path}: {error.detail}"
        answer = Refusal(code=f"http.{error.status_code}", message=message, remedy="Go back to the page.")
        return JSONResponse(answer.model_dump(exclude_none=True), error.status_code, error.headers)

    @app.exception_handler(Exception)  # answered outside every middleware, and then logged by the server
    async def _(request: Request, _: Exception) -> JSONResponse:
        answer = refusal(DiffuscopeError("something happened that nobody foresaw"))
        answer.headers.update(rules(request.url.path))
        return answer


def rules(path: str) -> dict[str, str]:
    """The page's rules for its browser; what the instrument says of people and itself is not kept there."""
    return HEADERS | ({"Cache-Control": "no-store"} if path.startswith("/api/") else {})


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

        is_upload = scope["path"] == UPLOAD_PATH  # the only body that is a file; who receives it has its own limit
        app = _TOO_LARGE if not is_upload and _is_too_large(Headers(scope=scope)) else self.app
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
        "visit": capture.report.get("visit"), "slot": capture.report.get("slot"),
        "test": capture.report.get("visit") is None,
        "verdict": capture.report.get("verdict"),
        "files": capture.files,
        "links": {
            "picture": f"{at}/picture.png", "raw": f"{at}/raw.tiff", "report": f"{at}/report.json",
            "quick": f"{at}/quick.jpg",
        },
    }  # fmt: skip


def _captures(app: FastAPI, owner: Owner, people: People, promised: Promised, only_one: Any) -> None:
    store = owner.house.store

    @app.post("/api/captures", status_code=201, dependencies=[only_one])
    async def press(press: Press) -> dict[str, Any]:
        """Take one picture and keep it: of a slot of a visit with consent, or, without both, a test picture."""
        kept = people.answered(press.key) if press.key else None
        if kept is not None:  # by an instrument that was started anew since then
            return shown(store.get(kept))
        errand = people.errand(press.eye, press.key, press.visit, press.slot)
        future = owner.exam.press(press.eye, press.key, errand)
        if press.visit is not None:
            promised.add(press.visit, future)
        return shown(await asyncio.wrap_future(future))

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
        quick = owner.quick(id) if name == "quick.jpg" else None
        content = quick if quick is not None else store.read(id, name)
        return Response(content, media_type=MEDIA[Path(name).suffix])


def _state(app: FastAPI, owner: Owner, people: People, notices: Notices) -> None:
    store = owner.house.store

    @app.get("/api/status")
    def status() -> dict[str, Any]:
        """What this instrument is and does now."""
        spec, head, problem = owner.house.spec, owner.head, owner.problem
        radius_px = field_radius_px(head.calibration) if head is not None else float("inf")
        return {
            "name": spec.name, "kind": kind_of(spec), "state": owner.state,
            "shape": head.camera.shape if head is not None else (spec.camera.rows, spec.camera.cols),
            "field_px": 2 * radius_px if radius_px < float("inf") else None, "version": app.version,
            "swept": [asdict(one) for one in notices.lost()], "space_left": store.space_left(),
            "people_left": store.people_left(len(people.protocol.slots)), "controller": notices.lease.holder,
            "problem": words(problem) if problem else None,
            "standing": [{"code": code, **facts} for code, facts in notices.standing().items()],
            "sending": notices.sender.counts() if notices.sender is not None else None,
            "notices": [one.remedy for one in owner.findings if not one.ok and not is_old(one)],
        }  # fmt: skip

    @app.get("/api/health")
    def health() -> dict[str, Any]:
        """Whether it can take pictures now: every check with its limit and what to do; and how the calibration fits."""
        known = facts(owner, len(people.protocol.slots), notices.sender)
        checks = judged(known)
        return {
            "ok": all(check.ok for check in checks), "state": known.state, "space_left": known.captures_left,
            "battery": known.battery if isinstance(known.battery, float) else None, "checks": as_json(checks),
            "calibration": shown_findings(owner.findings),
        }  # fmt: skip
