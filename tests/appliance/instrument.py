"""Fake instrument: a page over real HTTP with configurable answers."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from threading import Event, Thread

from services.health.checks import Check
from services.health.probe import as_json


def check(name: str, ok: bool = True) -> Check:
    return Check(name, ok, "as it should be" if ok else "broken", "well", "" if ok else "Mend it first.", True)


@dataclass
class Page:
    """Answers of the fake page."""

    at: str = ""
    state: str = "aim"
    battery: float | None = None
    checks: list[Check] = field(default_factory=lambda: [check("camera"), check("captures")])
    sees: bool = True
    hangs: bool = False
    pictured: timedelta | None = None  # age of the newest picture; None: no picture
    closing: Event = field(default_factory=Event)

    def answer(self, path: str) -> tuple[int, bytes]:
        match path:
            case "/api/status":
                taken_at = None if self.pictured is None else (datetime.now(UTC) - self.pictured).isoformat()
                status = {"state": self.state, "version": version("diffuscope"), "last_capture_at": taken_at}
                return 200, json.dumps(status).encode()
            case "/api/health":
                return 200, json.dumps({"battery": self.battery, "checks": as_json(self.checks)}).encode()
        return (200, b"\xff\xd8a picture") if self.sees else (204, b"")


@contextmanager
def served() -> Iterator[Page]:
    """Yield a running page."""
    page = Page()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if page.hangs:
                page.closing.wait(20)
            status, body = page.answer(self.path)
            self.send_response(status)
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self) -> None:
            """Answer a request of the control lease."""
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'{"lease": "probe", "mine": true}')

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda request, address: None  # type: ignore[method-assign]  # the client closed the connection
    page.at = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield page
    finally:
        page.closing.set()
        server.shutdown()
        server.server_close()
