"""Limits of simultaneous uses by client: event streams, waits for a live picture, connections.

Local and remote clients are counted apart, so that remote ones cannot lock out the screen of the device.
"""

import ipaddress
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

from fastapi import Request

from services.errors import ServerFull

RETRY_S = 5
IPV6_PREFIX = 64  # one client has a whole /64 network


@dataclass(frozen=True)
class ClientLimits:
    """Maximum numbers: `local` for all loopback clients together, `remote` for all others, `per_address` for one."""

    local: int
    remote: int
    per_address: int


STREAM_LIMITS = ClientLimits(local=16, remote=16, per_address=4)
PREVIEW_LIMITS = ClientLimits(local=16, remote=16, per_address=4)


@dataclass(frozen=True)
class Client:
    """Client of a connection: whether it is local (loopback), and its address; an IPv6 address is its /64 network."""

    is_local: bool
    address: str

    @classmethod
    @lru_cache(maxsize=1024)
    def at(cls, host: str) -> "Client":
        """Return the client at an IP address; another text, such as the name of a test client, is a remote client."""
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            return cls(False, host)
        if isinstance(address, ipaddress.IPv6Address):
            if address.ipv4_mapped is None:
                network = ipaddress.ip_network((address, IPV6_PREFIX), strict=False)
                return cls(address.is_loopback, str(network))
            address = address.ipv4_mapped
        return cls(address.is_loopback, str(address))


class ClientCounts:
    """Number of uses by client. Not thread-safe: the event loop calls it."""

    def __init__(self, limits: ClientLimits) -> None:
        self._limits = limits
        self._by_client: Counter[Client] = Counter()
        self._by_locality: Counter[bool] = Counter()

    def is_address_full(self, client: Client) -> bool:
        """Return whether a remote client has as many uses as one address may have; local ones have no such limit."""
        return not client.is_local and self._by_client[client] >= self._limits.per_address

    def is_full(self, client: Client) -> bool:
        """Return whether all local clients, or all remote ones, have as many uses as they may have."""
        return self._by_locality[client.is_local] >= (self._limits.local if client.is_local else self._limits.remote)

    def add(self, client: Client) -> None:
        """Count one use more."""
        self._by_client[client] += 1
        self._by_locality[client.is_local] += 1

    def remove(self, client: Client) -> None:
        """Count one use less."""
        self._by_client[client] -= 1
        if not self._by_client[client]:
            del self._by_client[client]
        self._by_locality[client.is_local] -= 1

    @contextmanager
    def admitted(self, client: Client) -> Iterator[None]:
        """Count one use during the context; ServerFull if a limit is reached."""
        if self.is_full(client) or self.is_address_full(client):
            raise ServerFull("too many screens ask for this at once", wait_s=RETRY_S)
        self.add(client)
        try:
            yield
        finally:
            self.remove(client)


def limit_clients(limits: ClientLimits) -> Callable[..., AsyncIterator[None]]:
    """Return the dependency of an endpoint that counts its requests until their answer is sent; ServerFull beyond."""
    counts = ClientCounts(limits)

    async def admitted(request: Request) -> AsyncIterator[None]:
        with counts.admitted(Client.at(request.client.host if request.client is not None else "")):
            yield

    return admitted
