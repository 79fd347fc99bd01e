"""Who may ask: requests by the instrument's own names, and changes from its own page or from no page at all."""

import ipaddress
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from device.errors import DiffuscopeError, Forged, WrongHost

SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
Answer = Callable[[DiffuscopeError], Response]


class OwnPageOnly:
    """Refuses a foreign name that points here, and changes that a foreign page asks for."""

    def __init__(self, app: ASGIApp, names: tuple[str, ...], answer: Answer) -> None:
        self.app, self.names, self.answer = app, frozenset(name.lower() for name in names), answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        error = self._error(scope) if scope["type"] == "http" else None
        await (self.app if error is None else self.answer(error))(scope, receive, send)

    def _error(self, scope: Scope) -> DiffuscopeError | None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host"), headers.get("origin")
        if host is not None and not is_own(host, self.names):
            return WrongHost(f"{host[:80]!r} is not a name of this camera")
        if scope["method"] not in SAFE and origin is not None and _authority(origin) != (host or "").lower():
            return Forged(f"a page of {origin[:80]!r} asked for a change")
        return None


def is_own(host: str, names: frozenset[str]) -> bool:
    """Whether a Host header names this computer: an address, localhost, *.local, or one of `names`."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        urlsplit(f"//{host}").port  # noqa: B018  # refuses what is no port
    except ValueError:
        return False
    if name in names or name == "localhost" or name.endswith(".local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def own_names() -> tuple[str, ...]:
    """The name of this computer, by which a network may know it."""
    return (socket.gethostname(),)


def _authority(origin: str) -> str:
    """Host and port of an Origin, as a Host header has them; nothing for "null" and nonsense."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
