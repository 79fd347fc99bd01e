"""Connection limits of the real server: numbers, time-outs of header, body and answer, TLS and two ports."""

import asyncio
import http.client
import json
import socket
import ssl
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from device.clock import SystemClock
from services.http.client_limits import ClientLimits
from services.http.connection_limits import ConnectionLimits
from services.identity.certificates import SHARED_HOST_NAMES, create_authority, create_server_certificate
from tests.journey.serving import connected, is_closed, served

GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
SHORT = ConnectionLimits(header_timeout_s=0.4, body_timeout_s=0.4, body_bytes_per_s=100.0, send_timeout_s=0.6)
LARGE_BYTES = 40_000_000  # more than the buffers of both sockets


class App:
    """ASGI application: /wait answers once `gate` is set, /large sends LARGE_BYTES, other paths the body's length."""

    def __init__(self) -> None:
        self.gate, self.is_waiting = Event(), Event()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        body, message = b"", {"more_body": True}
        while message.get("more_body"):
            message = await receive()
            body += message.get("body", b"")
        while scope["path"] == "/wait" and not self.gate.is_set():
            self.is_waiting.set()
            await asyncio.sleep(0.01)
        content = bytes(LARGE_BYTES) if scope["path"] == "/large" else json.dumps(len(body)).encode()
        headers = [(b"content-length", str(len(content)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})


def bytes_until_end(client: socket.socket) -> int:
    """Return the number of bytes that can be read until the server's end or reset of the connection."""
    read = 0
    with suppress(ConnectionResetError):
        while chunk := client.recv(1_000_000):
            read += len(chunk)
    return read


def answer_on(client: socket.socket) -> bytes:
    """Return the body of the next answer on a connection."""
    answer = http.client.HTTPResponse(client)
    answer.begin()
    return answer.read()


def get(port: int, path: str = "/", **options: Any) -> bytes:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10, **options)) as connection:
        connection.request("GET", path)
        return connection.getresponse().read()


@pytest.mark.parametrize(
    "sent",
    [b"", b"GET / HTTP/1.1\r\nX-Slow: 1\r\n", GET, b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n1"],
    ids=["nothing", "half a header", "a whole request, then nothing", "half a body"],
)
def test_a_connection_that_sends_nothing_more_is_closed(sent: bytes) -> None:
    with served(App(), SHORT) as (port,), closing(connected(port, sent)) as client:
        if sent == GET:
            assert answer_on(client) == b"0"
        assert is_closed(client)


def test_a_header_in_single_bytes_does_not_prolong_its_time_out() -> None:
    with served(App(), SHORT) as (port,), closing(connected(port)) as client:
        is_over = Event()

        def send_slowly() -> None:
            for byte in GET * 3:
                if is_over.wait(0.05):
                    return
                try:
                    client.send(bytes([byte]))
                except OSError:
                    return

        sender = Thread(target=send_slowly)
        sender.start()
        assert is_closed(client)
        is_over.set()
        sender.join()


def test_a_body_above_the_minimum_rate_may_take_longer_than_its_time_out() -> None:
    head = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 400\r\n\r\n"
    with served(App(), SHORT) as (port,), closing(connected(port, head)) as client:
        for _ in range(8):
            client.sendall(b"x" * 50)
            assert not Event().wait(0.1)
        assert answer_on(client) == b"400"


def test_an_answer_that_is_not_read_ends_its_connection() -> None:
    with served(App(), SHORT) as (port,), socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", port))
        client.settimeout(10)
        client.sendall(b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert not Event().wait(1.5)
        assert bytes_until_end(client) < LARGE_BYTES


def test_an_answer_that_is_read_slowly_is_sent_whole() -> None:
    with served(App(), SHORT) as (port,), closing(connected(port, b"GET /large HTTP/1.0\r\n\r\n")) as client:
        read = 0
        while chunk := client.recv(2_000_000):
            read += len(chunk)
            assert not Event().wait(0.02)
        assert read > LARGE_BYTES


def test_a_request_is_answered_among_more_idle_connections_than_permitted() -> None:
    app = App()
    with served(app, ConnectionLimits(ClientLimits(local=4, remote=4, per_address=4))) as (port,), ExitStack() as undo:
        waiting = undo.enter_context(closing(connected(port, b"GET /wait HTTP/1.1\r\nHost: localhost\r\n\r\n")))
        assert app.is_waiting.wait(10)
        idle = [undo.enter_context(closing(connected(port))) for _ in range(20)]
        assert get(port) == b"0"
        assert all(is_closed(connection) for connection in idle[:16])
        app.gate.set()
        assert answer_on(waiting) == b"0"


def test_a_new_connection_is_refused_while_all_are_answered() -> None:
    app = App()
    with served(app, ConnectionLimits(ClientLimits(local=2, remote=2, per_address=2))) as (port,), ExitStack() as undo:
        busy = []
        for _ in range(2):
            app.is_waiting.clear()
            busy.append(undo.enter_context(closing(connected(port, b"GET /wait HTTP/1.0\r\n\r\n"))))
            assert app.is_waiting.wait(10)
        assert is_closed(undo.enter_context(closing(connected(port))))
        app.gate.set()
        assert [answer_on(connection) for connection in busy] == [b"0", b"0"]


@pytest.fixture
def tls(tmp_path: Path) -> dict[str, Path]:
    """uvicorn's options of TLS with a certificate of `authority.pem`."""
    authority = create_authority("eye", SystemClock())
    pem = create_server_certificate(*authority[:2], "eye", SystemClock())
    for name, content in (("server.pem", pem), ("authority.pem", authority[1])):
        (tmp_path / name).write_bytes(content)
    return {"ssl_keyfile": tmp_path / "server.pem", "ssl_certfile": tmp_path / "server.pem"}


def test_connections_without_a_tls_handshake_are_limited_as_others(tls: dict[str, Path]) -> None:
    limits = ConnectionLimits(ClientLimits(local=4, remote=4, per_address=4), header_timeout_s=1.0)
    with served(App(), limits, tls) as (port,), ExitStack() as undo:
        first, *idle = [undo.enter_context(closing(connected(port))) for _ in range(5)]
        first.settimeout(0.5)
        assert is_closed(first)  # the fifth took its place, before any time-out
        assert all(is_closed(connection) for connection in idle)


def test_a_tls_port_and_a_plain_port_share_one_limit(tls: dict[str, Path], tmp_path: Path) -> None:
    trusted = ssl.create_default_context(cafile=str(tmp_path / "authority.pem"))
    app, limits = App(), ConnectionLimits(ClientLimits(local=3, remote=3, per_address=3))
    with served(app, limits, tls, {}) as (secure, plain), ExitStack() as undo:

        def wrapped() -> ssl.SSLSocket:
            client = undo.enter_context(closing(connected(secure)))
            return undo.enter_context(closing(trusted.wrap_socket(client, server_hostname=SHARED_HOST_NAMES[0])))

        idle = [wrapped() for _ in range(3)]
        assert get(plain) == b"0"
        assert is_closed(idle[0])
        asking = wrapped()
        asking.sendall(GET)
        assert answer_on(asking) == b"0"
