"""Who may ask: requests by the instrument's own names, and changes and light for its own page or no page at all.

A live picture is a GET that makes the lamp shine, and any page in the world may hold an <img> with its address. So
whoever asks must be known: by `Sec-Fetch-Site`, which browsers write themselves (over https, or at this computer), or
by `X-Controller`, which no foreign page can write without being asked first whether it may.
"""

import ipaddress
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from device.errors import DiffuscopeError, Forged, WrongHost

SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
SHINING = frozenset({"/api/preview"})
OWN = frozenset({"same-origin", "none"})  # `none`: a person typed the address
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
        if scope["path"] in SHINING and not _is_known(headers):
            return Forged("nobody knows which page asked for light", "Open the camera's own page to aim.")
        return None


def _is_known(headers: Headers) -> bool:
    site = headers.get("sec-fetch-site")
    return "x-controller" in headers if site is None else site in OWN


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
