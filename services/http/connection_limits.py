"""Limits of TCP connections: their number by client, and time-outs of header, body and answer.

uvicorn limits only the time between two requests of a connection. At a limit, `ConnectionTable` closes the connection
that has waited longest for bytes of its client, so that connections without a request cannot lock out one with a
request; a connection whose request is being answered is never closed for another.
"""

import asyncio
import socket
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, cast

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from device.clock import Clock
from services.http.client_limits import Client, ClientCounts, ClientLimits

REFUSALS = 64  # of one call of accept, then other connections are served
CLIENTS = ClientLimits(local=256, remote=256, per_address=32)


@dataclass(frozen=True)
class ConnectionLimits:
    """Numbers of connections, and time-outs in seconds.

    `header_timeout_s`: from the opening, or the previous answer, to the end of the header. `body_timeout_s`: from the
    header to the end of the body, one second more for each `body_bytes_per_s` received. `send_timeout_s`: during which
    a client that has bytes of an answer to receive takes none of them.
    """

    clients: ClientLimits = CLIENTS
    header_timeout_s: float = 10.0
    body_timeout_s: float = 10.0
    body_bytes_per_s: float = 1000.0
    send_timeout_s: float = 20.0


class Connection(Protocol):
    """Connection as the table needs it; each method returns at once."""

    @property
    def remote_client(self) -> Client:
        """The client at the other end."""

    def is_sending(self) -> bool:
        """Return whether bytes of an answer wait to be sent."""

    def is_overdue(self, now_s: float) -> bool:
        """Return whether a time-out of header, body or answer is over."""

    def drop(self) -> None:
        """Close the connection, without waiting for bytes to be sent."""


class ConnectionTable:
    """Open connections of all listening sockets. Not thread-safe: the event loop calls it."""

    def __init__(self, limits: ConnectionLimits, clock: Clock) -> None:
        self.limits, self.clock = limits, clock
        self._counts = ClientCounts(limits.clients)
        self._open: set[Connection] = set()
        self.handshakes: dict[object, Connection] = {}  # of TLS, by the address of the client
        # Connections that wait for bytes of their client, by locality of the client; the longest wait is the first.
        self._waiting: dict[bool, dict[Connection, None]] = {False: {}, True: {}}

    def __len__(self) -> int:
        return len(self._open)

    def is_refused(self, client: Client) -> bool:
        """Return whether a new connection of a remote client is refused: its address has as many as permitted."""
        return self._counts.is_address_full(client)

    def add(self, connection: Connection) -> None:
        """Add a new connection, which waits for its client; at a limit, drop another one or the new one.

        If an address has as many as permitted, the new one is dropped. If all local or all remote clients have, the one
        of them that has waited longest is dropped, and the new one if none waits.
        """
        client = connection.remote_client
        if self.is_refused(client):
            connection.drop()
            return
        if self._counts.is_full(client):
            waiting = self._waiting[client.is_local]
            rival = next((other for other in waiting if not other.is_sending()), connection)
            self.remove(rival)
            rival.drop()
            if rival is connection:
                return
        self._open.add(connection)
        self._counts.add(client)
        self.set_waiting(connection, True)

    def set_waiting(self, connection: Connection, is_waiting: bool) -> None:
        """Note whether a connection waits for bytes of its client from now on; no effect for a removed one."""
        waiting = self._waiting[connection.remote_client.is_local]
        waiting.pop(connection, None)
        if is_waiting and connection in self._open:
            waiting[connection] = None

    def remove(self, connection: Connection) -> None:
        """Remove a closed connection; no effect for one that was removed or never added."""
        if connection in self._open:
            self.set_waiting(connection, False)
            self._open.remove(connection)
            self._counts.remove(connection.remote_client)

    def end_handshake(self, address: object) -> None:
        """Remove the handshake of a client at this address and port, if there is one."""
        if (handshake := self.handshakes.pop(address, None)) is not None:
            self.remove(handshake)

    def drop_overdue(self) -> None:
        """Drop every connection whose time-out is over; to be called several times per second."""
        now_s = self.clock.now_s()
        for overdue in [connection for connection in self._open if connection.is_overdue(now_s)]:
            self.remove(overdue)
            overdue.drop()


class HandshakeSocket(socket.socket):
    """Accepted socket that is in the table of connections from its opening to the end of its TLS handshake.

    uvicorn creates its HTTP connection after the handshake. The header time-out is that of the handshake too. It takes
    over the file descriptor of `accepted`.
    """

    def __init__(self, accepted: socket.socket, address: Any, table: ConnectionTable) -> None:
        super().__init__(accepted.family, accepted.type, accepted.proto, fileno=accepted.detach())
        self._table, self._address, self._opened_s = table, address, table.clock.now_s()
        self.remote_client = Client.at(address[0])
        table.handshakes[address] = self
        table.add(self)

    def is_sending(self) -> bool:
        """Return False: a handshake is a few kilobytes."""
        return False

    def is_overdue(self, now_s: float) -> bool:
        """Return whether the time-out of the handshake is over."""
        return now_s - self._opened_s > self._table.limits.header_timeout_s

    def drop(self) -> None:
        """Shut the connection down; its transport reads the end and closes it."""
        with suppress(OSError):  # the client has closed it
            self.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection, and leave the table."""
        self._table.end_handshake(self._address)
        super().close()


class LimitedListener(socket.socket):
    """Listening socket that closes connections of an address beyond its limit, before anything is allocated for them.

    It takes over the file descriptor of `listener`. `is_tls`: connections enter the table before their handshake.
    """

    def __init__(self, listener: socket.socket, table: ConnectionTable, is_tls: bool = False) -> None:
        super().__init__(listener.family, listener.type, listener.proto, fileno=listener.detach())
        self._table, self._is_tls = table, is_tls

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection; BlockingIOError if none waits, or after REFUSALS refused ones."""
        for _ in range(REFUSALS):
            connection, address = super().accept()
            if not self._table.is_refused(Client.at(address[0])):
                return HandshakeSocket(connection, address, self._table) if self._is_tls else connection, address
            connection.close()
        raise BlockingIOError


class LimitedConfig(uvicorn.Config):
    """uvicorn's configuration with limited connections: HTTP/1.1, no WebSocket, no headers of a proxy."""

    def __init__(self, app: ASGIApp, connections: ConnectionTable, **options: Any) -> None:
        super().__init__(app, http=LimitedProtocol, ws="none", proxy_headers=False, log_level="warning", **options)
        self.connections = connections


class LimitedProtocol(H11Protocol):
    """HTTP connection of uvicorn in the table of connections of its `LimitedConfig`."""

    def __init__(
        self,
        config: uvicorn.Config,
        server_state: ServerState,
        app_state: dict[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        assert isinstance(config, LimitedConfig)
        self._table = config.connections
        self._remote_client = Client.at("")
        self._phase: object = h11.IDLE
        self._phase_since_s = self._sent_since_s = self._table.clock.now_s()
        self._body_bytes = self._unsent_bytes = 0

    @property
    def remote_client(self) -> Client:
        """The client at the other end."""
        return self._remote_client

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Enter the table; a client that acknowledges no byte for the send time-out is disconnected."""
        super().connection_made(cast(asyncio.Transport, transport))
        self._remote_client = Client.at(self.client[0] if self.client is not None else "")
        self._table.end_handshake(transport.get_extra_info("peername"))
        timeout_ms = round(self._table.limits.send_timeout_s * 1000)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, timeout_ms)
        self._table.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the table."""
        self._table.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process bytes of the client."""
        super().data_received(data)
        if self._phase is h11.SEND_BODY:
            self._body_bytes += len(data)
        self._enter_phase()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._enter_phase()

    def is_sending(self) -> bool:
        """Return whether bytes of an answer wait to be sent."""
        return self.transport.get_write_buffer_size() > 0

    def is_overdue(self, now_s: float) -> bool:
        """Return whether a time-out of header, body or answer is over."""
        limits = self._table.limits
        waited_s = now_s - self._phase_since_s
        if self._note_sending(now_s):
            return now_s - self._sent_since_s > limits.send_timeout_s
        if self._phase is h11.IDLE:
            return waited_s > limits.header_timeout_s
        extension_s = self._body_bytes / limits.body_bytes_per_s
        return self._phase is h11.SEND_BODY and waited_s > limits.body_timeout_s + extension_s

    def drop(self) -> None:
        """Close the connection, without waiting for bytes to be sent."""
        self.transport.abort()

    def _enter_phase(self) -> None:
        if self.conn.their_state is not self._phase:
            self._phase, self._phase_since_s, self._body_bytes = self.conn.their_state, self._table.clock.now_s(), 0
            self._table.set_waiting(self, self._phase in (h11.IDLE, h11.SEND_BODY))

    def _note_sending(self, now_s: float) -> bool:
        """Return whether bytes wait to be sent; remember when the client last took some."""
        unsent_bytes = self.transport.get_write_buffer_size()
        if not self._unsent_bytes or unsent_bytes < self._unsent_bytes:
            self._sent_since_s = now_s
        self._unsent_bytes = unsent_bytes
        return unsent_bytes > 0
