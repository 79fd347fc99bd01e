"""Access control: the table of operations with their roles and actions, and the dependency that enforces the roles.

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

# Who may send an operation, and the action of it in the audit log. None: not recorded, since it is a page or a state of
# the instrument, which names no patient, the next step of an action, or a sign that the user is there.
OPERATIONS: dict[str, tuple[Access, str | None]] = {
    "GET /": (PUBLIC, None),
    "GET /technician": (PUBLIC, None),
    "GET /web/{name:path}": (PUBLIC, None),
    "GET /api/login": (PUBLIC, None),
    "POST /api/login": (PUBLIC, "sign-in"),
    "DELETE /api/login": (PUBLIC, "sign-out"),
    "POST /api/login/activity": (ANY_USER, None),
    "POST /api/login/confirm": (ANY_USER, "confirm"),
    "PUT /api/login/secret": (ANY_USER, "change-own-secret"),
    "POST /api/setup": (PUBLIC, "set-up"),
    "GET /api/users": (USERS, "list-users"),
    "POST /api/users": (USERS, "add-user"),
    "PATCH /api/users/{name}": (USERS, "change-user"),
    "DELETE /api/users/{name}": (USERS, "remove-user"),
    "GET /api/ssh-keys": (ADMINISTRATION, None),
    "POST /api/ssh-keys": (USERS, "decide-ssh-key"),
    "GET /api/openapi.json": (ANY_USER, None),
    "GET /api/audit": (ADMINISTRATION, "read-audit"),
    "GET /api/status": (MONITORED, None),
    "GET /api/health": (MONITORED, None),
    "GET /api/programme": (ANY_USER, None),
    "POST /api/clock": (ANY_USER, "set-clock"),
    "POST /api/clock/back": (USERS, "set-clock-back"),
    "GET /api/events": (ANY_USER, None),
    "POST /api/controller": (SCREEN, "hold-camera"),
    "GET /api/preview": (LIGHT, None),
    "POST /api/captures": (LIGHT, "capture"),
    "GET /api/captures": (PICTURES, "list-pictures"),
    "GET /api/captures/{id}": (PICTURES, "view"),
    "GET /api/captures/{id}/{name}": (PICTURES, "view"),
    "POST /api/captures/{id}/accept": (EXAM, "accept-picture"),
    "POST /api/captures/{id}/eye": (EXAM, "change-eye"),
    "GET /api/visits": (READ, "list-visits"),
    "POST /api/visits": (EXAM, "begin-visit"),
    "GET /api/visits/{id}": (READ, "view"),
    "GET /api/visits/{id}/changes": (READ, "view"),
    "PATCH /api/visits/{id}": (EXAM, "answer"),
    "POST /api/visits/{id}/slots": (EXAM, "choose-picture"),
    "POST /api/visits/{id}/not-possible": (EXAM, "not-possible"),
    "POST /api/visits/{id}/finish": (EXAM, "finish"),
    "POST /api/visits/{id}/reopen": (EXAM, "reopen"),
    "GET /api/visits/{id}/montage/{eye}": (READ, "view"),
    "GET /api/visits/{id}/montage/{eye}/picture.png": (READ, "view"),
    "GET /api/patients": (USERS, "find-patient"),
    "POST /api/patients/erase": (USERS, "erase-patient"),
    "GET /api/exports": (READ, None),
    "POST /api/visits/{id}/export": (READ, "export"),
    "GET /api/visits/{id}/export.zip": (READ, "export"),
    "GET /api/upload-queue": (ANY_USER, None),
    "POST /api/upload-queue/retry": (UPLOADS, "retry-upload"),
    "GET /api/calibration": (SERVICE, None),
    "POST /api/calibration": (SERVICE, "calibrate"),
    "POST /api/calibration/ready": (SERVICE, None),
    "POST /api/calibration/cancel": (SERVICE, "cancel-calibration"),
    "POST /api/calibration/use": (SERVICE, "use-calibration"),
    "GET /api/calibration/preview": (SERVICE, None),
    "POST /api/calibration/trial-lenses": (SERVICE, "calibrate"),
    "POST /api/calibration/trial-lenses/ready": (SERVICE, None),
    "GET /api/technician/accuracy": (SERVICE, None),
    "GET /api/technician/accuracy.svg": (SERVICE, None),
    "POST /api/technician/accuracy": (SERVICE, "measure-accuracy"),
    "PUT /api/technician/pace": (SERVICE, "set-time-budget"),
    "GET /api/technician/captures/{id}/again.png": (SERVICE, "view"),
    "GET /api/technician/event-log": (UPKEEP, "read-event-log"),
    "GET /api/technician/event-log.txt": (UPKEEP, "read-event-log"),
    "POST /api/technician/event-log/export": (UPKEEP, "export-event-log"),
    "GET /api/technician/backup": (UPKEEP, None),
    "POST /api/technician/backup": (UPKEEP, "backup"),
    "POST /api/technician/backup/passphrase": (KEYS, "set-backup-passphrase"),
    "GET /api/technician/removal": (UPKEEP, None),
    "POST /api/technician/removal": (UPKEEP, "remove-pictures"),
    "POST /api/technician/removal/undo": (UPKEEP, "bring-back-pictures"),
    "GET /api/update": (UPKEEP, None),
    "POST /api/update/check": (UPKEEP, "look-for-update"),
    "POST /api/update/install": (UPKEEP, "update"),
    "POST /api/update/restart": (UPKEEP, "restart"),
    "PUT /api/update/file": (UPKEEP, "bring-update"),
}


def access_required(authenticator: Authenticator, rates: RateLimits) -> Callable[[Request], Awaitable[None]]:
    """Return the dependency of every endpoint: it admits the user of a request by `OPERATIONS`, or raises.

    It leaves in `request.state` the `user` (None for a request without a login), `operation` and `audit_address` for
    the audit trail, and `is_admitted`, by which `may` asks for an operation while the request is open. LoginRequired,
    SetupRequired, ConfirmationRequired or AccessDenied; TooManyRequests beyond the rate of an address, or of a user who
    is admitted.
    """

    async def admit(request: Request) -> None:
        operation = f"{request.method} {_template(request)}"
        if operation not in OPERATIONS:
            raise AccessDenied(f"{operation} is not in the table of rights")
        rule, _ = OPERATIONS[operation]
        token, peer = login_token(request), Peer.of(request)
        acts = rule.is_use and request.method not in SAFE_METHODS
        request.state.operation, request.state.audit_address = operation, peer.address
        request.state.user = None
        request.state.user = user = _admitted(authenticator, rule, token, peer, acts)
        rates.count(operation, peer.address if user is None else user.name)
        request.state.is_admitted = lambda asked: _is_admitted(authenticator, OPERATIONS[asked][0], token, peer)

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
    """Return whether the user of a request may also send `operation`, a key of `OPERATIONS`, now."""
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
