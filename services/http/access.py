"""Access control: the table endpoint x role, and the dependency of the application that enforces it.

An operation that is not in the table is refused. The table grants by role; two rules need the body of a request and
are here too: light with a visit is the screener's, light without one (a test picture) is the technician's.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from starlette.requests import HTTPConnection, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.errors import AccessDenied, LoginRequired, SetupRequired, StoreDamaged
from services.http.authentication import Authenticator, Peer
from services.http.rate_limits import RateLimits
from services.http.security import SAFE_METHODS, ErrorResponse
from services.identity.users import ROLES, Role, User

COOKIE, SECURE_COOKIE = "login", "__Host-login"


@dataclass(frozen=True)
class Access:
    """Who may send an operation: users with one of `roles`; without a login the device itself, or anybody.

    `confirmed`: the secret was typed recently. `is_use`: a changing request restarts the idle lock.
    """

    roles: frozenset[Role] = frozenset()
    from_device: bool = False
    from_anywhere: bool = False
    confirmed: bool = False
    is_use: bool = True


PUBLIC = Access(from_anywhere=True)
ANY_USER = Access(frozenset(ROLES))
MONITORED = Access(frozenset(ROLES), from_device=True)  # also read by the updater and by `diffuscope health`
EXAM = Access(frozenset({"screener"}))
LIGHT = Access(frozenset({"screener", "technician"}))
SCREEN = Access(frozenset({"screener", "technician"}), is_use=False)  # sent by an open page without its user
READ = Access(frozenset({"screener", "reader"}))
PICTURES = Access(frozenset({"screener", "reader", "technician"}))  # no names
UPLOADS = Access(frozenset({"screener", "technician"}))
SERVICE = Access(frozenset({"technician"}))
UPKEEP = Access(frozenset({"technician", "administrator"}))
KEYS = Access(frozenset({"technician", "administrator"}), confirmed=True)
ADMINISTRATION = Access(frozenset({"administrator"}))
USERS = Access(frozenset({"administrator"}), confirmed=True)

ACCESS: dict[str, Access] = {
    "GET /": PUBLIC,
    "GET /technician": PUBLIC,
    "GET /web/{name:path}": PUBLIC,
    "GET /api/login": PUBLIC,
    "POST /api/login": PUBLIC,
    "DELETE /api/login": PUBLIC,
    "POST /api/login/activity": ANY_USER,
    "POST /api/login/confirm": ANY_USER,
    "PUT /api/login/secret": ANY_USER,
    "POST /api/setup": PUBLIC,
    "GET /api/users": USERS,
    "POST /api/users": USERS,
    "PATCH /api/users/{name}": USERS,
    "DELETE /api/users/{name}": USERS,
    "GET /api/ssh-keys": ADMINISTRATION,
    "POST /api/ssh-keys": USERS,
    "GET /api/openapi.json": ANY_USER,
    "GET /api/audit": ADMINISTRATION,
    "GET /api/status": MONITORED,
    "GET /api/health": MONITORED,
    "GET /api/programme": ANY_USER,
    "POST /api/clock": ANY_USER,
    "POST /api/clock/back": USERS,
    "GET /api/events": ANY_USER,
    "POST /api/controller": SCREEN,
    "GET /api/preview": LIGHT,
    "POST /api/captures": LIGHT,
    "GET /api/captures": PICTURES,
    "GET /api/captures/{id}": PICTURES,
    "GET /api/captures/{id}/{name}": PICTURES,
    "POST /api/captures/{id}/accept": EXAM,
    "POST /api/captures/{id}/eye": EXAM,
    "GET /api/visits": READ,
    "POST /api/visits": EXAM,
    "GET /api/visits/{id}": READ,
    "GET /api/visits/{id}/changes": READ,
    "PATCH /api/visits/{id}": EXAM,
    "POST /api/visits/{id}/slots": EXAM,
    "POST /api/visits/{id}/not-possible": EXAM,
    "POST /api/visits/{id}/finish": EXAM,
    "POST /api/visits/{id}/reopen": EXAM,
    "GET /api/visits/{id}/montage/{eye}": READ,
    "GET /api/visits/{id}/montage/{eye}/picture.png": READ,
    "GET /api/patients": USERS,
    "POST /api/patients/erase": USERS,
    "GET /api/exports": READ,
    "POST /api/visits/{id}/export": READ,
    "GET /api/visits/{id}/export.zip": READ,
    "GET /api/upload-queue": ANY_USER,
    "POST /api/upload-queue/retry": UPLOADS,
    "GET /api/calibration": SERVICE,
    "POST /api/calibration": SERVICE,
    "POST /api/calibration/ready": SERVICE,
    "POST /api/calibration/cancel": SERVICE,
    "POST /api/calibration/use": SERVICE,
    "GET /api/calibration/preview": SERVICE,
    "POST /api/calibration/trial-lenses": SERVICE,
    "POST /api/calibration/trial-lenses/ready": SERVICE,
    "GET /api/technician/accuracy": SERVICE,
    "GET /api/technician/accuracy.svg": SERVICE,
    "POST /api/technician/accuracy": SERVICE,
    "PUT /api/technician/pace": SERVICE,
    "GET /api/technician/captures/{id}/again.png": SERVICE,
    "GET /api/technician/event-log": UPKEEP,
    "GET /api/technician/event-log.txt": UPKEEP,
    "POST /api/technician/event-log/export": UPKEEP,
    "GET /api/technician/backup": UPKEEP,
    "POST /api/technician/backup": UPKEEP,
    "POST /api/technician/backup/passphrase": KEYS,
    "GET /api/technician/removal": UPKEEP,
    "POST /api/technician/removal": UPKEEP,
    "POST /api/technician/removal/undo": UPKEEP,
    "GET /api/update": UPKEEP,
    "POST /api/update/check": UPKEEP,
    "POST /api/update/install": UPKEEP,
    "POST /api/update/restart": UPKEEP,
    "PUT /api/update/file": UPKEEP,
}


def access_required(authenticator: Authenticator, rates: RateLimits) -> Callable[[Request], Awaitable[None]]:
    """Return the dependency of every endpoint: it admits the user of a request by `ACCESS`, or raises.

    It leaves in `request.state` the `user` (None for a request without a login), `operation` and `audit_address` for
    the audit trail, and `is_admitted`, by which `may` asks for an operation while the request is open. LoginRequired,
    SetupRequired, ConfirmationRequired or AccessDenied; TooManyRequests beyond the rate of an address, or of a user who
    is admitted.
    """

    async def admit(request: Request) -> None:
        operation = f"{request.method} {_template(request)}"
        rule = ACCESS.get(operation)
        if rule is None:
            raise AccessDenied(f"{operation} is not in the table of rights")
        token, peer = login_token(request), Peer.of(request)
        acts = rule.is_use and request.method not in SAFE_METHODS
        request.state.operation, request.state.audit_address = operation, peer.address
        request.state.user = None
        request.state.user = user = _admitted(authenticator, rule, token, peer, acts)
        rates.count(operation, peer.address if user is None else user.name)
        request.state.is_admitted = lambda asked: _is_admitted(authenticator, ACCESS[asked], token, peer)

    return admit


class AdmittedAnswers:
    """ASGI middleware: a success that `access_required` has not admitted becomes AccessDenied.

    A route that is no endpoint of FastAPI, such as a mounted application, has no dependencies. `answer` turns an error
    into a response.
    """

    def __init__(self, app: ASGIApp, answer: ErrorResponse) -> None:
        self.app, self._answer = app, answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one ASGI request to the application; its answer is refused unless its operation was admitted."""
        is_refused = False

        async def send_admitted(message: Message) -> None:
            nonlocal is_refused
            is_success = message["type"] == "http.response.start" and message["status"] < 300
            if is_success and "operation" not in scope.get("state", {}):
                is_refused = True
                refused = AccessDenied(f"{scope['method']} {scope['path']} is not in the table of rights")
                await self._answer(refused)(scope, receive, send)
            elif not is_refused:
                await send(message)

        await self.app(scope, receive, send_admitted)


def _template(request: Request) -> str:
    """Return the path of the endpoint of a request as in the OpenAPI document, such as /api/visits/{id}.

    A route of a nested router names the end of its path only; prefixes of routers have no parameters.
    """
    route: str = request.scope["route"].path
    parts = request.url.path.split("/")
    return route if route.endswith(":path}") else "/".join(parts[: len(parts) - route.count("/")]) + route


def login_token(request: HTTPConnection) -> str | None:
    """Return the token of the login that a request carries: over TLS that of the cookie with the __Host- prefix."""
    return request.cookies.get(cookie_name(request))


def cookie_name(request: HTTPConnection) -> str:
    """Return the name of the login cookie: over TLS with the prefix that binds it to this host and to TLS."""
    return SECURE_COOKIE if request.url.scheme == "https" else COOKIE


def require_light_role(request: Request, visit: str | None) -> None:
    """Raise AccessDenied unless the user may light the eye: a screener for a visit, a technician without one."""
    role: Role = "technician" if visit is None else "screener"
    if role not in signed_in(request).roles:
        raise AccessDenied(f"light {'without' if visit is None else 'for'} a visit needs the role {role}")


def may(request: Request, operation: str) -> bool:
    """Return whether the user of a request may also send `operation`, a key of `ACCESS`, now."""
    try:
        return bool(request.state.is_admitted(operation))
    except StoreDamaged:  # no user is admitted; the device itself still reads its status
        return False


def signed_in(request: Request) -> User:
    """Return the user whom `access_required` admitted; LoginRequired for a request without a login."""
    user: User | None = request.state.user
    if user is None:
        raise LoginRequired("no user is signed in")
    return user


def _admitted(authenticator: Authenticator, rule: Access, token: str | None, peer: Peer, acts: bool) -> User | None:
    if rule.from_anywhere or (rule.from_device and peer.is_own_screen):
        return None
    user = authenticator.user(token, peer, acts)
    if user is None:
        if not authenticator.users.has_begun:
            raise SetupRequired("no user exists yet")
        raise LoginRequired("no user is signed in")
    if not user.roles & rule.roles:
        raise AccessDenied(f"{user.name} has none of the roles {', '.join(sorted(rule.roles))}")
    if rule.confirmed and not user.is_demo:
        authenticator.logins.require_confirmed(token)
    return user


def _is_admitted(authenticator: Authenticator, rule: Access, token: str | None, peer: Peer) -> bool:
    user = authenticator.user(token, peer)
    return rule.from_anywhere or (user is not None and bool(user.roles & rule.roles))
