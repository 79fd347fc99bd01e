"""Clients that hold many connections to a server: idle, slow, waiting for live pictures, not reading event streams."""

import multiprocessing
import random
import resource
import select
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.synchronize import Event

REOPEN_S = 60.0  # mean time after which an attacker opens a closed connection again
SLOW_BYTE_S = 5.0
NO_NAME = b"Host: localhost\r\nX-Controller: stranger\r\n"
HEADER = b"GET /api/status HTTP/1.1\r\n" + NO_NAME
BODY = b"POST /api/captures HTTP/1.1\r\n" + NO_NAME + b"Content-Type: application/json\r\nContent-Length: 1000\r\n\r\n"
PREVIEW = b"GET /api/preview?after=999999 HTTP/1.1\r\n" + NO_NAME + b"\r\n"
STREAM = b"GET /api/events HTTP/1.1\r\n" + NO_NAME + b"\r\n"


@dataclass(frozen=True)
class Attack:
    """One kind of attack: `connections` at once; connection `k` begins with `opening(k)`.

    `trickle(k)` is sent every SLOW_BYTE_S; `repeated` is sent again after each answer; `reads` the answers or not.
    """

    name: str
    connections: int
    opening: Callable[[int], bytes] = lambda _: b""
    trickle: Callable[[int], bytes] = lambda _: b""
    repeated: bytes = b""
    reads: bool = True


ATTACKS = {
    attack.name: attack
    for attack in (
        Attack("idle", 1300),
        Attack("slow", 1500, lambda k: BODY if k % 2 else HEADER, lambda k: b" " if k % 2 else b"X-Slow: 1\r\n"),
        Attack("previews", 120, lambda _: PREVIEW, repeated=PREVIEW),
        Attack("streams", 400, lambda _: STREAM, reads=False),
    )
}


def untrusting_context() -> ssl.SSLContext:
    """Return the TLS context of a client that takes any certificate."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


@contextmanager
def under_attack(name: str, host: str, port: int, reopen_s: float = REOPEN_S) -> Iterator[None]:
    """Attack a server from another process, beginning with the opening of all connections."""
    context = multiprocessing.get_context("spawn")
    is_over = context.Event()
    process = context.Process(target=_attack, args=(name, host, port, is_over, reopen_s), daemon=True)
    process.start()
    try:
        yield
    finally:
        is_over.set()
        process.join(20)
        process.kill()


def _attack(name: str, host: str, port: int, is_over: Event, reopen_s: float = REOPEN_S) -> None:
    """Hold the connections of an attack until `is_over`; a connection that the server closes is opened again."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    attack = ATTACKS[name]
    crowd = _Crowd(attack, host, port, reopen_s)
    for k in range(attack.connections):
        crowd.open(k)
        if k % 50 == 0:
            crowd.step(0)
    while not is_over.is_set():
        crowd.step(0.05)


class _Crowd:
    """Connections of one attack; `step` reads answers, sends slow bytes and opens closed connections again."""

    def __init__(self, attack: Attack, host: str, port: int, reopen_s: float) -> None:
        self._attack, self._address, self._reopen_s = attack, (host, port), reopen_s
        self._poll, self._tls = select.poll(), untrusting_context()
        self._sockets: dict[int, tuple[int, socket.socket]] = {}
        self._due: list[tuple[float, int]] = []
        self._trickled_s = time.monotonic()

    def open(self, k: int) -> None:
        """Open connection `k`; a refused one is tried again later."""
        client = socket.socket()
        client.settimeout(2.0)
        try:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536 if self._attack.reads else 4096)
            client.connect(self._address)
            if opening := self._attack.opening(k):  # an idle connection does not begin its handshake either
                client = self._tls.wrap_socket(client)
                client.sendall(opening)
        except OSError:
            self._close(k, client)
            return
        client.setblocking(False)
        self._sockets[client.fileno()] = k, client
        mask = select.POLLRDHUP | (select.POLLIN if self._attack.reads else 0)
        self._poll.register(client, mask)

    def step(self, wait_s: float) -> None:
        """Serve every connection once."""
        for number, events in self._poll.poll(wait_s * 1000):
            k, client = self._sockets[number]
            if events & ~select.POLLIN or not self._answered(client):
                self._poll.unregister(number)
                del self._sockets[number]
                self._close(k, client)
        now_s = time.monotonic()
        if now_s - self._trickled_s > SLOW_BYTE_S:
            self._trickled_s = now_s
            for k, client in self._sockets.values():
                with suppress(OSError):
                    client.send(self._attack.trickle(k))
        due = [k for due_s, k in self._due if due_s <= now_s]
        self._due = [(due_s, k) for due_s, k in self._due if due_s > now_s]
        for k in due:
            self.open(k)

    def _close(self, k: int, client: socket.socket) -> None:
        client.close()
        self._due.append((time.monotonic() + random.uniform(0.5, 1.5) * self._reopen_s, k))

    def _answered(self, client: socket.socket) -> bool:
        """Read the answer of a request, and send the next one; return whether the connection is open."""
        try:
            answer = client.recv(65536)
            if answer.startswith(b"HTTP/1.1 503"):
                return False  # a refused client tries again later
            if answer and self._attack.repeated:
                client.send(self._attack.repeated)
        except ssl.SSLWantReadError:
            return True  # a record of TLS without bytes of an answer
        except OSError:
            return False
        return bool(answer)
