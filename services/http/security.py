"""Security middlewares: CSRF and DNS rebinding (Host, Origin, Sec-Fetch-Site), body limit, HEAD, security headers.

Changing requests with a foreign `Origin` or `Sec-Fetch-Site` are refused. `GET /api/preview` turns the lamp on, and a
foreign page can send it with an <img>: it needs a same-origin `Sec-Fetch-Site` (browsers set it over https and on
localhost), or, without that header, any `X-Controller`, which a foreign page cannot send without a CORS preflight.
"""

import asyncio
import ipaddress
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from device.errors import DiffuscopeError, InputError
from services.errors import CrossOriginRequest, UntrustedHost
from services.identity.certificates import SHARED_HOST_NAMES

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
LIGHT_EMITTING_PATHS = frozenset({"/api/preview"})
SAME_ORIGIN_SITES = frozenset({"same-origin", "none"})  # `none`: the user typed the URL
MAX_BODY_BYTES = 10_000
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types lit-html"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
ErrorResponse = Callable[[DiffuscopeError], Response]


class CrossOriginProtection:
    """ASGI middleware against CSRF: refuse untrusted hosts, and changing or light-emitting requests from other origins.

    `names` are accepted host names (case-insensitive); `answer` turns an error into a response.
    """

    def __init__(self, app: ASGIApp, names: tuple[str, ...], answer: ErrorResponse) -> None:
        self.app = app
        self.names = frozenset(name.lower() for name in names)
        self.answer = answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a permitted ASGI request to the application; answer a refused one with its error."""
        error = self._error(scope) if scope["type"] == "http" else None
        await (self.app if error is None else self.answer(error))(scope, receive, send)

    def _error(self, scope: Scope) -> DiffuscopeError | None:
        headers = Headers(scope=scope)
        host = headers.get("host")
        origin = headers.get("origin")
        if host is not None and not is_trusted_host(host, self.names, (scope.get("server") or ("",))[0]):
            return UntrustedHost(f"{host[:80]!r} is not a name of this camera")
        if scope["method"] not in SAFE_METHODS and origin is not None and _authority(origin) != (host or "").lower():
            return CrossOriginRequest(f"a page of {origin[:80]!r} asked for a change")
        if scope["method"] not in SAFE_METHODS and headers.get("sec-fetch-site", "none") not in SAME_ORIGIN_SITES:
            return CrossOriginRequest("a page of another site asked for a change")
        if scope["path"] in LIGHT_EMITTING_PATHS and not _is_same_origin(headers):
            return CrossOriginRequest("the page that requested light is unknown", "Open the camera's own page to aim.")
        return None


def _is_same_origin(headers: Headers) -> bool:
    """Return whether a request comes from the own page: by Sec-Fetch-Site, or without it by any X-Controller."""
    site = headers.get("sec-fetch-site")
    return "x-controller" in headers if site is None else site in SAME_ORIGIN_SITES


def is_trusted_host(host: str, names: frozenset[str], address: str) -> bool:
    """Return whether a Host header is valid and trusted: one of `names`, localhost, or the `address` of the connection.

    A name that a foreign name server resolves to this computer is none of these (DNS rebinding).
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        urlsplit(f"//{host}").port  # noqa: B018  # ValueError for an invalid port
    except ValueError:
        return False
    if name in names or name == "localhost":
        return True
    try:
        called = ipaddress.ip_address(name)
        return called.is_loopback or called == _unmapped(ipaddress.ip_address(address))
    except ValueError:
        return False


def _unmapped(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return the IPv4 address of a client that an IPv6 socket accepted, other addresses unchanged."""
    return getattr(address, "ipv4_mapped", None) or address


def own_host_names() -> tuple[str, ...]:
    """Return the names of this computer: its host name, and those that avahi publishes."""
    name = socket.gethostname()
    return name, f"{name}.local", *SHARED_HOST_NAMES


def _authority(origin: str) -> str:
    """Return host and port of an Origin as in a Host header, in lower case; "" for "null" and invalid values."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


class BodyLimit:
    """ASGI middleware: refuse bodies over `MAX_BODY_BYTES` with the answer for an InputError.

    A chunked body, which declares no length, is read up to the limit before the application gets it. `exempt` are the
    paths whose body is a file; their endpoints have their own limit.
    """

    def __init__(self, app: ASGIApp, exempt: frozenset[str], answer: ErrorResponse) -> None:
        self.app, self.exempt = app, exempt
        self._too_large = answer(InputError("this request is too large", "Reload the page and try again."))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one ASGI request to the application, or answer 422 for a body that is too large."""
        if scope["type"] != "http" or scope["path"] in self.exempt:
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        body: bytes | None = b""
        if is_chunked := headers.get("transfer-encoding", "").lower() == "chunked" and "content-length" not in headers:
            body = await _read_body(receive)
        if body is None or (not is_chunked and _is_too_large(headers)):
            await self._too_large(scope, receive, send)
        else:
            await self.app(scope, _replayed(body, receive) if is_chunked else receive, send)


def _is_too_large(headers: Headers) -> bool:
    """Return True for another coding than chunked, and for a declared length over the limit or that is no number."""
    length = headers.get("content-length") or "0"
    return "transfer-encoding" in headers or not length.isdecimal() or int(length) > MAX_BODY_BYTES


async def _read_body(receive: Receive) -> bytes | None:
    """Return a body without a declared length; None if it is longer than `MAX_BODY_BYTES`, or if the client left."""
    body = b""
    while len(body) <= MAX_BODY_BYTES:
        message = await receive()
        if message["type"] != "http.request":
            return None
        body += message.get("body", b"")
        if not message.get("more_body", False):
            return body if len(body) <= MAX_BODY_BYTES else None
    return None


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that returns a body that was read, and then what follows it."""
    pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return pending.pop() if pending else await receive()

    return replay


class HeadRequests:
    """ASGI middleware: answer HEAD as GET, with the same headers and no body.

    A stream ends with its headers. A path that lights is not called: its answer is that of no picture, 204.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one ASGI request to the application, HEAD as a GET whose client leaves after the headers."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return
        if scope["path"] in LIGHT_EMITTING_PATHS:
            await Response(status_code=204)(scope, receive, send)
            return
        answered = asyncio.Event()
        is_asked = False

        async def receive_nothing() -> Message:
            nonlocal is_asked
            if not is_asked:
                is_asked = True
                return {"type": "http.request", "body": b"", "more_body": False}
            await answered.wait()
            return {"type": "http.disconnect"}

        async def send_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answered.set()

        asgi = {**scope.get("asgi", {}), "spec_version": "2.3"}  # a stream then watches whether its client has left
        await self.app({**scope, "method": "GET", "asgi": asgi}, receive_nothing, send_headers)


class SecurityHeaders:
    """ASGI middleware: add the security headers to every answer. Streamed answers pass through unbuffered."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one ASGI request to the application and add the headers to its answer."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(security_headers(scope["path"]))
            await send(message)

        await self.app(scope, receive, with_headers if scope["type"] == "http" else send)


def security_headers(path: str) -> dict[str, str]:
    """Return the security headers for this path (Content-Security-Policy and others), with `no-store` under /api/."""
    return SECURITY_HEADERS | ({"Cache-Control": "no-store"} if path.startswith("/api/") else {})
