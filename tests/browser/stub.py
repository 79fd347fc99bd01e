"""A simulation of the HTTP API, for states that the real server shows only when something breaks.

The journeys run against the real server; this stand-in holds the page's error and waiting states still, so that they
can be looked at. It keeps nothing, and every picture in it is drawn.
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
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse
from fastapi.staticfiles import StaticFiles
from PIL import Image

WEB = Path(__file__).parents[2] / "web"
ROWS, COLS, FIELD_PX = 540, 960, 260
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "require-trusted-types-for 'script'; trusted-types lit-html"
)


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


@dataclass
class Stub:
    """What the pretended instrument does next; tests set the fields, the page sees the answers."""

    expose_s: float = 0.1
    refine_s: float = 0.3
    kind: str = "simulated"
    problem: dict[str, str] | None = None
    swept: list[str] = field(default_factory=list)
    refuse: tuple[int, dict[str, str]] | None = None
    warnings: list[str] = field(default_factory=list)
    busy: bool = False
    preview_age_ms: int = 40
    silent: bool = False
    closing: bool = False
    presses: int = 0
    captures: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[str, dict[str, Any]]] = field(default_factory=list)

    def reset(self) -> None:
        """As new, for the next test."""
        vars(self).update(vars(Stub()))

    def tell(self, kind: str, data: dict[str, Any]) -> None:
        self.events.append((kind, data))

    def stage(self, name: str, stage: str, fraction: float, left_s: float) -> None:
        url = f"/api/captures/{name}/quick.jpg" if stage != "expose" else None
        self.tell("stage", {"id": name, "stage": stage, "url": url, "fraction": fraction, "left_s": left_s})

    def capture(self, name: str, eye: str) -> dict[str, Any]:
        return {
            "id": name,
            "eye": eye,
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
    _live(app, stub)

    @app.get("/")
    def index() -> FileResponse:
        return FileResponse(WEB / "index.html", headers={"Content-Security-Policy": CSP})

    app.mount("/web", StaticFiles(directory=WEB), name="web")
    return app


def _status(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/status")
    def status() -> dict[str, Any]:
        state = "busy" if stub.busy else "aim"
        return {"name": "Stub head", "kind": stub.kind, "state": state, "shape": [ROWS, COLS], "field_px": FIELD_PX,
                "version": "0.0", "swept": stub.swept, "problem": stub.problem}  # fmt: skip


def _captures(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/captures")
    def captures(limit: int = 20) -> dict[str, Any]:
        return {"captures": stub.captures[:limit]}

    @app.post("/api/captures", status_code=201)
    async def press(wish: dict[str, str]) -> Any:
        stub.presses += 1
        if stub.refuse:
            return JSONResponse(stub.refuse[1], stub.refuse[0])
        name = f"20261120T1000{stub.presses:02d}-{wish['eye']}-stub"
        stub.tell("state", {"state": "busy"})
        stub.stage(name, "expose", 0.05, stub.refine_s)
        await asyncio.sleep(stub.expose_s)
        for step in range(5):
            stub.stage(name, "quick" if step == 0 else "refine", 0.2 + 0.15 * step, stub.refine_s * (1 - step / 5))
            await asyncio.sleep(stub.refine_s / 5)
        stub.stage(name, "keep", 1.0, 0)
        stub.captures.insert(0, stub.capture(name, wish["eye"]))
        stub.tell("kept", stub.captures[0])
        stub.tell("state", {"state": "aim"})
        return stub.captures[0]

    @app.get("/api/captures/{name}/{file}")
    def kept(name: str, file: str) -> Response:
        kind, blur = ("jpeg", 8) if file == "quick.jpg" else ("png", 1)
        return Response(encoded(kind, blur), media_type=f"image/{kind}")


def _live(app: FastAPI, stub: Stub) -> None:
    @app.get("/api/preview")
    async def preview(after: int) -> Response:
        await asyncio.sleep(0.1)
        headers = {"X-Frame": str(after + 1), "X-Age-Ms": str(stub.preview_age_ms)}
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
