"""Test receiver of visit archives: an HTTPS server that stores them in memory, with injectable faults."""

import base64
import hashlib
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread

KEY = "a-key-of-this-device"


@dataclass
class Receiver:
    """State of the server: stored archives, requests, and the faults of the next requests.

    `answers` are statuses returned instead of the normal answer, by method; `put_fault` is the fault of a PUT: "half"
    stores the first half and answers 201, "mute" stores everything and closes without an answer, "cut" closes in the
    middle, "dribble" answers slowly, byte by byte. Every request waits for `gate`, requests after a stored PUT also for
    `after_put`.
    """

    at: str = ""
    kept: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    answers: dict[str, int] = field(default_factory=dict)
    put_fault: str = "well"
    sends_digest: bool = True
    gate: Event = field(default_factory=Event)
    after_put: Event = field(default_factory=Event)
    over: Event = field(default_factory=Event)

    def settings(self, folder: Path, **more: object) -> dict[str, object]:
        """Return the send settings of a device for this receiver."""
        token = folder / "send.token"
        token.write_text(f"{KEY}\n")
        return {"address": f"{self.at}/inbox", "token": token, "answer_s": 5.0} | more


class Handler(BaseHTTPRequestHandler):
    """One request; the state is the server's."""

    protocol_version = "HTTP/1.1"
    server: "Quiet"

    def do_HEAD(self) -> None:
        known = self.server.known
        if self._is_answered():
            return
        content = known.kept.get(self.path)
        self.send_response(404 if content is None else 200)
        if content is not None and known.sends_digest and self.headers["Want-Repr-Digest"]:
            digest = base64.b64encode(hashlib.sha256(content).digest()).decode()
            self.send_header("Repr-Digest", f"sha-256=:{digest}:")
        self.send_header("Content-Length", str(len(content or b"")))
        self.end_headers()

    def do_PUT(self) -> None:
        known, length = self.server.known, int(self.headers["Content-Length"])
        content = self.rfile.read(length // 2 if known.put_fault == "cut" else length)
        self.close_connection = True
        if len(content) < length or self._is_answered():
            return
        if self.path in known.kept and self.headers["If-None-Match"] == "*":
            self._send_status(412)
            return
        known.kept[self.path] = content[: length // 2] if known.put_fault == "half" else content
        while known.put_fault == "dribble" and not known.over.wait(0.2):
            self.wfile.write(b"H")
        if known.put_fault not in ("mute", "dribble"):
            self._send_status(201)

    def _is_answered(self) -> bool:
        known = self.server.known
        known.asked.append(self.command)
        known.gate.wait(30)
        if "PUT" in known.asked[:-1]:
            known.after_put.wait(30)
        status = known.answers.get(self.command)
        if status is None and self.headers["Authorization"] != f"Bearer {KEY}":
            status = 401
        if status is not None:
            self._send_status(status)
        return status is not None

    def _send_status(self, status: int) -> None:
        self.send_response(status)
        if status == 302:
            self.send_header("Location", f"{self.server.known.at}/elsewhere")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


class Quiet(ThreadingHTTPServer):
    """HTTP server that does not log connection errors."""

    daemon_threads = True

    def __init__(self, known: Receiver, port: int) -> None:
        super().__init__(("127.0.0.1", port), Handler)
        self.known = known

    def handle_error(self, request: object, client_address: object) -> None:
        pass


@contextmanager
def receiving(certificate: Path, key: Path, port: int = 0) -> Iterator[Receiver]:
    """Yield a running receiver on localhost."""
    known = Receiver()
    known.gate.set()
    known.after_put.set()
    server = Quiet(known, port)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server.socket = context.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    known.at = f"https://localhost:{server.server_port}"
    thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield known
    finally:
        known.over.set()
        known.gate.set()
        known.after_put.set()
        server.shutdown()
        server.server_close()
        thread.join(10)
