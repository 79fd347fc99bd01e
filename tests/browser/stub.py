"""A simulation of the HTTP API, for states that the real server shows only when something breaks.

The journeys run against the real server; this stand-in holds the page's error and waiting states still, so that they
can be looked at. It keeps nothing, and every picture in it is drawn. It reads requests by the real server's own models;
that its answers have the real server's shapes is tested in `tests/journey/test_stub.py`.
"""

import asyncio
import io
import json
import threading
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Header, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from PIL import Image

from device.errors import InputError
from services.instrument.api import Press, SafeHeaders, refusal
from services.instrument.outbox_api import TryNow
from services.instrument.page import page
from services.instrument.visits_api import Answered, Asking, Away, Begin, Chosen, CouldNot, OfEye, Order
from tests.browser.stub_visits import PROTOCOL, Visits

ROWS, COLS, FIELD_PX = 540, 960, 260
OTHER = {"code": "link.other", "message": "Another screen is taking pictures.", "remedy": "Use this one instead."}
UNKNOWN = {"code": "store.unknown", "message": "This is not kept here.", "remedy": "Choose from the list."}
BUSY = {"code": "busy", "message": "A picture is being taken.", "remedy": "Wait until it is done, then press again."}
CUT = {"code": "light.cut", "message": "The light went out.", "remedy": "Take it again."}
NO_CONSENT = {
    None: {"code": "consent.missing", "message": "A0142 has not agreed yet.", "remedy": "First ask the person."},
    "declined": {"code": "consent.declined", "message": "A0142 did not agree.", "remedy": "Take no pictures."},
}
FULL = {"code": "store.full", "message": "No room.", "remedy": "Make room."}


def drawn_retina(blur: int, shift: float = 0.0) -> Image.Image:
    """A disc with a bright nerve head and dark lines; `blur` in pixels, `shift` moves it a little."""
    rows, cols = np.mgrid[:ROWS, :COLS].astype(np.float32)
    y, x = (rows - ROWS / 2) / (FIELD_PX / 2), (cols - COLS / 2 - shift) / (FIELD_PX / 2)
    lit = (np.hypot(x, y) < 1).astype(np.float32)
    glow = 0.55 + 0.45 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.02) - 0.2 * np.exp(-((x + 0.25) ** 2 + y**2) / 0.03)
    for bend in (-0.9, -0.45, 0.45, 0.9):
        line = bend * np.sqrt(np.clip(0.55 - x, 0, None))
        glow -= 0.22 * np.exp(-((y - line) ** 2) / 0.0004) * (x < 0.5)
    colour = np.stack([glow * 205, glow * 105, glow * 50], -1) * lit[..., None]
    picture = Image.fromarray(colour.clip(0, 255).astype(np.uint8))
    return picture.resize((COLS // blur, ROWS // blur)).resize((COLS, ROWS)) if blur > 1 else picture


@lru_cache
def encoded(kind: str, blur: int, shift: float = 0.0) -> bytes:
    out = io.BytesIO()
    drawn_retina(blur, shift).save(out, kind)
    return out.getvalue()


class Lost(Exception):
    """A press of which nothing is kept."""

    def __init__(self, status: int, words: dict[str, str]) -> None:
        super().__init__(words["code"])
        self.status, self.words = status, words


@dataclass
class Stub:
    """What the pretended instrument does next; tests set the fields, the page sees the answers."""

    expose_s: float = 0.1
    refine_s: float = 0.3
    hold: str | None = None  # a press waits before its "verdict" or its "keep" for as long as this says so
    verdicts: list[str | None] = field(default_factory=list)  # causes of the next pictures; None and none left: good
    aim: dict[str, Any] | None = field(default_factory=lambda: {"code": "ready", "fill": 0.9})
    controller: str | None = None
    visits: Visits = field(default_factory=Visits)
    patched: list[tuple[str, Any]] = field(default_factory=list)
    kind: str = "simulated"
    problem: dict[str, str] | None = None
    notices: list[str] = field(default_factory=list)
    standing: dict[str, dict[str, Any]] = field(default_factory=dict)  # what `notice` told, and is not over
    sending: bool = False  # whether a receiver is set up
    unsent: list[dict[str, Any]] = field(default_factory=list)  # who waits for it
    tried: list[str | None] = field(default_factory=list)
    swept: list[dict[str, Any]] = field(default_factory=list)
    refuse: tuple[int, dict[str, str]] | None = None
    warnings: list[str] = field(default_factory=list)
    busy: bool = False
    preview_age_ms: int = 40
    silent: bool = False
    closing: bool = False
    presses: int = 0
    seats: int = 2  # pictures in the making at once
    making: int = 0
    cut: list[int] = field(default_factory=list)  # the presses, counted from one, whose light goes out too early
    lose: list[int] = field(default_factory=list)  # those that are called good, and cannot be kept
    captures: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[str, dict[str, Any]]] = field(default_factory=list)

    def reset(self) -> None:
        """As new, for the next test."""
        vars(self).update(vars(Stub()))

    def without_consent(self, visit: str | None) -> JSONResponse | None:
        """The refusal of light for a visit without consent."""
        consent = self.visits.kept[visit]["fields"].get("consent") if visit else "agreed"
        return None if consent == "agreed" else JSONResponse(NO_CONSENT[consent], 409)

    def tell(self, kind: str, data: dict[str, Any]) -> None:
        if kind == "notice" and data.get("over"):
            self.standing.pop(data["code"], None)
        elif kind == "notice" and data["code"] != "eye.side":
            self.standing[data["code"]] = data
        self.events.append((kind, data))

    async def release(self, what: str) -> None:
        while self.hold == what:
            await asyncio.sleep(0.02)

    def stage(self, wish: dict[str, str], name: str, stage: str, fraction: float, left_s: float) -> None:
        url = f"/api/captures/{name}/quick.jpg" if stage != "expose" else None
        whose = {part: wish.get(part) for part in ("key", "visit", "slot")}
        self.tell("stage", {"id": name, "stage": stage, "url": url, "fraction": fraction, "left_s": left_s, **whose})

    def next_verdict(self) -> dict[str, Any]:
        code = self.verdicts.pop(0) if self.verdicts else None
        return {"word": "again" if code else "good", "code": code, "numbers": {}}

    async def made(self, wish: dict[str, str]) -> dict[str, Any] | None:
        """One picture, told step by step; nothing if the test that pressed is over."""
        name = f"20261120T1000{self.presses:02d}-{wish['eye']}-stub"
        verdict, shelf = self.next_verdict(), self.visits
        number = self.presses
        self.tell("state", {"state": "busy"})
        self.stage(wish, name, "expose", 0.05, self.refine_s)
        await asyncio.sleep(self.expose_s)
        if number in self.cut:
            raise Lost(423, CUT)
        self.tell("state", {"state": "busy" if self.making >= self.seats else "making"})
        for step in range(5):
            self.stage(
                wish, name, "quick" if step == 0 else "refine", 0.2 + 0.15 * step, self.refine_s * (1 - step / 5)
            )
            if step == 2:
                await self.release("verdict")
                self.tell("verdict", {"id": name, **verdict})
            await asyncio.sleep(self.refine_s / 5)
            if step == 4:
                await self.release("keep")
            if self.visits is not shelf:
                return None
        if number in self.lose:
            raise Lost(507, FULL)
        self.stage(wish, name, "keep", 1.0, 0)
        self.captures.insert(0, self.capture(name, wish, verdict))
        if wish.get("visit"):
            self.visits.taken(wish["visit"], wish["slot"], name, verdict)
        self.tell("kept", self.captures[0])
        return self.captures[0]

    async def seated(self, wish: dict[str, str]) -> Any:
        """The same as an answer; its seat is free again after it."""
        self.making += 1
        try:
            return await self.made(wish) or JSONResponse(UNKNOWN, 404)
        except Lost as lost:
            return JSONResponse(lost.words, lost.status)
        finally:
            self.making = max(0, self.making - 1)  # a test that is over has emptied the seats
            self.tell("state", {"state": "making" if self.making else "aim"})

    def capture(self, name: str, wish: dict[str, Any], verdict: dict[str, Any]) -> dict[str, Any]:
        return {
            "id": name,
            "eye": wish["eye"],
            "visit": wish.get("visit"),
            "slot": wish.get("slot"),
            "test": wish.get("visit") is None,
            "verdict": verdict,
            "taken_at": datetime.now(UTC).isoformat(),
            "simulated": True,
            "calibration_id": "0123456789abcdef",
            "report": {"method": "stub", "rounds": 8, "stopped": "done", "seconds": {"refine": self.refine_s},
                       "quality": {}, "warnings": self.warnings},
            "files": {},
            "links": {
                "picture": f"/api/captures/{name}/picture.png",
                "raw": f"/api/captures/{name}/raw.tiff",
                "report": f"/api/captures/{name}/report.json",
                "quick": f"/api/captures/{name}/quick.jpg",
            },
        }  # fmt: skip


def build(stub: Stub) -> FastAPI:
    """The app around one pretended instrument."""
    app = FastAPI()
    _status(app, stub)
    _captures(app, stub)
    _visits(app, stub)
    _decisions(app, stub)
    _live(app, stub)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> JSONResponse:
        return refusal(InputError(str(error.errors()[0]["msg"]), "Reload the page and try again."))

    page(app)
    app.add_middleware(SafeHeaders)
    return app


def _status(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/status")
    def status() -> dict[str, Any]:
        told = [data["state"] for kind, data in stub.events if kind == "state"]
        state = "busy" if stub.busy else ["aim", *told][-1]
        return {"name": "Stub head", "kind": stub.kind, "state": state, "shape": [ROWS, COLS], "field_px": FIELD_PX,
                "version": "0.0", "swept": stub.swept, "problem": stub.problem, "people_left": 356, "space_left": 1424,
                "sending": {"sent": 20, "waiting": len(stub.unsent)} if stub.sending else None,
                "controller": stub.controller and "a public name", "notices": stub.notices,
                "standing": list(stub.standing.values())}  # fmt: skip

    @app.get("/api/outbox")
    def outbox() -> dict[str, Any]:
        known = {"configured": stub.sending, "sent": 20 * stub.sending, "waiting": len(stub.unsent)}
        return known | {"next_try_s": 0 if stub.tried else 700, "visits": stub.unsent}

    @app.post("/api/outbox/try")
    def try_now(wish: TryNow) -> dict[str, Any]:
        stub.tried.append(wish.visit)
        return outbox()

    @app.post("/api/controller")
    def controller(wish: Asking) -> dict[str, Any]:
        if wish.release and stub.controller == wish.key:
            stub.controller = None
            return {"lease": "a public name", "mine": False}
        if stub.controller is None or wish.take:
            stub.controller = wish.key
        return {"lease": "a public name", "mine": stub.controller == wish.key}


def _captures(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/captures")
    def captures(limit: int = 20) -> dict[str, Any]:
        return {"captures": stub.captures[:limit]}

    @app.post("/api/captures", status_code=201)
    async def press(wish: Press, x_controller: str | None = Header(None)) -> Any:
        stub.presses += 1
        if stub.refuse:
            return JSONResponse(stub.refuse[1], stub.refuse[0])
        if stub.controller not in (None, x_controller):
            return JSONResponse(OTHER, 409)
        if (refused := stub.without_consent(wish.visit)) is not None:
            return refused
        return JSONResponse(BUSY, 409) if stub.making >= stub.seats else await stub.seated(wish.model_dump())

    @app.get("/api/captures/{name}")
    def one(name: str) -> Any:
        found = [capture for capture in stub.captures if capture["id"] == name]
        return found[0] if found else JSONResponse(UNKNOWN, 404)

    @app.post("/api/captures/{name}/eye")
    def move(name: str, wish: OfEye) -> Any:
        capture = next(capture for capture in stub.captures if capture["id"] == name)
        return stub.visits.move(capture, wish.eye)

    @app.post("/api/captures/{name}/keep")
    def keep(name: str, _: Order) -> Any:
        capture = next(capture for capture in stub.captures if capture["id"] == name)
        visit = stub.visits.kept[capture["visit"]]
        visit["slots"][capture["slot"]] |= {"state": "taken", "capture": name, "verdict": capture["verdict"]}
        return stub.visits.seen(visit)

    @app.get("/api/captures/{name}/{file}")
    def kept(name: str, file: str) -> Response:
        kind, blur = ("jpeg", 8) if file == "quick.jpg" else ("png", 1)
        return Response(encoded(kind, blur), media_type=f"image/{kind}")


def _visits(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/protocol")
    def protocol() -> dict[str, Any]:
        return PROTOCOL

    @app.get("/api/visits")
    def listed(day: str | None = None, open: bool = False, q: str = "") -> dict[str, Any]:
        return stub.visits.listed(day, open, q)

    @app.post("/api/visits", status_code=201)
    def begin(wish: Begin) -> dict[str, Any]:
        known = stub.visits.keys
        if wish.key not in known:
            known[wish.key] = stub.visits.begin(wish.number)
        return stub.visits.seen(known[wish.key])

    @app.get("/api/visits/{name}")
    def visit(name: str) -> Any:
        found = stub.visits.kept.get(name)
        return stub.visits.seen(found) if found else JSONResponse(UNKNOWN, 404)

    @app.patch("/api/visits/{name}")
    def patch(name: str, wish: Answered) -> dict[str, Any]:
        stub.patched.append((wish.field, wish.value))
        stub.visits.kept[name]["fields"][wish.field] = wish.value
        return stub.visits.seen(stub.visits.kept[name])

    @app.post("/api/visits/{name}/export")
    def export(name: str, wish: Away) -> dict[str, Any]:
        return {"folder": f"{wish.folder}/{name}"}

    @app.get("/api/exports")
    def exports() -> dict[str, Any]:
        return {"folders": [{"id": "/media/usb-1", "name": "USB stick BLUE", "free_bytes": 7_900_000_000}]}


def _decisions(app: FastAPI, stub: Stub) -> None:
    def change(name: str, what: str, wish: Order) -> dict[str, Any]:
        verdicts = {capture["id"]: capture["verdict"] for capture in stub.captures}
        return stub.visits.change(stub.visits.kept[name], what, wish.model_dump(), verdicts)

    @app.post("/api/visits/{name}/could-not")
    def could_not(name: str, wish: CouldNot) -> dict[str, Any]:
        return change(name, "could-not", wish)

    @app.post("/api/visits/{name}/slots")
    def choose(name: str, wish: Chosen) -> dict[str, Any]:
        return change(name, "slots", wish)

    @app.post("/api/visits/{name}/finish")
    def finish(name: str, wish: Order) -> dict[str, Any]:
        return change(name, "finish", wish)

    @app.post("/api/visits/{name}/reopen")
    def reopen(name: str, wish: Order) -> dict[str, Any]:
        return change(name, "reopen", wish)


def _live(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/preview")
    async def preview(after: int = Query(0, ge=0), visit: str | None = None) -> Response:
        if (refused := stub.without_consent(visit)) is not None:
            return refused
        await asyncio.sleep(0.25)  # four a second: drawing in software is what these tests wait for
        headers = {"X-Frame": str(after + 1), "X-Age-Ms": str(stub.preview_age_ms)}
        headers |= {"X-Aim": json.dumps(stub.aim)} if stub.aim else {}
        return Response(encoded("jpeg", 4, 3.0 * (after % 2)), media_type="image/jpeg", headers=headers)

    async def stream() -> AsyncIterator[str]:
        told = len(stub.events)
        beat = 0.0
        while not stub.closing:
            while told < len(stub.events):
                kind, data = stub.events[told]
                told += 1
                yield f"id: {told}\nevent: {kind}\ndata: {json.dumps(data)}\n\n"
            if time.monotonic() - beat > 1 and not stub.silent:
                beat = time.monotonic()
                yield 'event: beat\ndata: {"age": 0.1}\n\n'
            await asyncio.sleep(0.02)

    @app.get("/api/events")
    async def events() -> StreamingResponse:
        return StreamingResponse(stream(), media_type="text/event-stream")


class Stubbed:
    """The stub on a real port, in a thread, for as long as the context lasts."""

    def __init__(self, stub: Stub, port: int) -> None:
        self.stub = stub
        self.url = f"http://127.0.0.1:{port}"
        config = uvicorn.Config(build(stub), port=port, log_level="error", ws="none", timeout_graceful_shutdown=3)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run)

    def __enter__(self) -> "Stubbed":
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)
        return self

    def __exit__(self, *_: object) -> None:
        self.stub.closing = True  # ends the event streams, which would otherwise hold up the shutdown
        self._server.should_exit = True
        self._thread.join(10)
