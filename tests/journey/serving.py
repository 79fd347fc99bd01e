"""The real HTTP server in a thread of the test, with limits as arguments."""

import asyncio
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Thread
from typing import Any

from device.clock import SystemClock
from services.http.connection_limits import ConnectionLimits, ConnectionTable, LimitedConfig
from services.http.server import Server, bind_socket
from services.instrument.events import EventBus
from tests.journey.conftest import until


@contextmanager
def served(app: Any, limits: ConnectionLimits, *ports: dict[str, Any]) -> Iterator[tuple[int, ...]]:
    """Serve an ASGI application; `ports` are further options of uvicorn for each port, by default one plain port."""
    table = ConnectionTable(limits, SystemClock())
    configs = [LimitedConfig(app, table, timeout_graceful_shutdown=1, **port) for port in ports or ({},)]
    servers = [Server(config, EventBus()) for config in configs]
    with ExitStack() as undo:
        sockets = [undo.enter_context(bind_socket("127.0.0.1", 0)) for _ in servers]
        numbers = tuple(int(listener.getsockname()[1]) for listener in sockets)

        async def run() -> None:
            await asyncio.gather(*(server.serve([own]) for server, own in zip(servers, sockets, strict=True)))

        thread = Thread(target=lambda: asyncio.run(run()), name="served")
        thread.start()
        try:
            until(lambda: all(server.started for server in servers))
            yield numbers
        finally:
            for server in servers:
                server.should_exit = True
            thread.join(30)


def connected(port: int, sent: bytes = b"") -> socket.socket:
    """Return a connection to the server after sending some bytes."""
    client = socket.create_connection(("127.0.0.1", port), timeout=10)
    client.sendall(sent)
    return client


def is_closed(client: socket.socket) -> bool:
    """Return True once the server has closed the connection, False if it sent bytes; TimeoutError after 10 s."""
    try:
        return client.recv(1) == b""
    except ConnectionResetError:
        return True
