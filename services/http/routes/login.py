"""Endpoints of sign-in, set-up of an administrator, and the own secret."""

from collections.abc import Callable

from fastapi import APIRouter, Request, Response

from services.http.access import cookie_name, login_token
from services.http.audit_trail import RESET_ADMINISTRATOR
from services.http.authentication import Authenticator, Peer
from services.http.schemas.access import LoginAnswer, SecretChange, SecretConfirmation, SetUp, SignIn, UserAnswer
from services.identity.logins import IDLE_LOCK_S
from services.identity.users import ROLES, User


def login_router(authenticator: Authenticator, pressed_s: Callable[[], float | None]) -> APIRouter:
    """Return the router of sign-in and set-up; `pressed_s` as of `Authenticator.set_up`."""
    router = APIRouter()
    router.include_router(_begin_router(authenticator, pressed_s))
    router.include_router(_own_router(authenticator))
    return router


def _begin_router(authenticator: Authenticator, pressed_s: Callable[[], float | None]) -> APIRouter:
    """Return the router of the endpoints that need no login."""
    router = APIRouter()

    @router.get("/api/login")
    def login_state(request: Request) -> LoginAnswer:
        """Return the user of this client, and whether the device waits for its set-up."""
        return _answer(authenticator, authenticator.user(login_token(request), Peer.of(request)))

    @router.post("/api/login")
    def sign_in(typed: SignIn, request: Request, response: Response) -> LoginAnswer:
        """Sign in; sets the login cookie.

        401 before the first user, 403 for a wrong name or secret, 429 during the lock-out, with the time to wait.
        """
        request.state.audit_user = typed.name
        token = authenticator.sign_in(typed.name, typed.secret, Peer.of(request))
        authenticator.logins.end(login_token(request))
        return _begun(authenticator, token, request, response)

    @router.delete("/api/login")
    def sign_out(request: Request, response: Response) -> LoginAnswer:
        """Sign out, which locks the screen; no effect without a login."""
        request.state.user = authenticator.user(login_token(request), Peer.of(request))
        authenticator.logins.end(login_token(request))
        is_secure = request.url.scheme == "https"
        response.set_cookie(
            cookie_name(request), max_age=0, httponly=True, samesite="strict", path="/", secure=is_secure
        )
        return _answer(authenticator, None)

    @router.post("/api/setup")
    def set_up(typed: SetUp, request: Request, response: Response) -> LoginAnswer:
        """Create an administrator, or give one a new secret, with the set-up code of the device, and sign in.

        With users only within 30 s after a press of the device's button; a device without one asks for a request from
        its own screen. All logins of the administrator end. 403 without the press and for a wrong or used code, 422
        for a name or secret that cannot be used, 429 during the lock-out.
        """
        request.state.audit_user = typed.name
        if authenticator.users.has_begun:
            request.state.audit_action = RESET_ADMINISTRATOR
        token = authenticator.set_up(typed.code, typed.name, typed.secret, Peer.of(request), pressed_s())
        return _begun(authenticator, token, request, response)

    return router


def _own_router(authenticator: Authenticator) -> APIRouter:
    """Return the router of the endpoints of a signed-in user."""
    router = APIRouter()

    @router.post("/api/login/activity")
    def restart_idle_lock(request: Request) -> LoginAnswer:
        """Restart the idle lock, because the user touches the page; 401 without a login."""
        return _answer(authenticator, request.state.user)

    @router.post("/api/login/confirm")
    def confirm(typed: SecretConfirmation, request: Request) -> LoginAnswer:
        """Type the own secret again, before an action with a risk; 403 for a wrong one, 429 during the lock-out."""
        authenticator.confirm(login_token(request), typed.secret, Peer.of(request))
        return _answer(authenticator, request.state.user)

    @router.put("/api/login/secret")
    def change_secret(typed: SecretChange, request: Request, response: Response) -> LoginAnswer:
        """Change the own secret, which signs out all other screens; 403 for a wrong one, 422 for a weak one."""
        token = authenticator.change_secret(login_token(request), typed.secret, typed.new, Peer.of(request))
        return _begun(authenticator, token, request, response)

    return router


def _begun(authenticator: Authenticator, token: str, request: Request, response: Response) -> LoginAnswer:
    """Set the login cookie, which ends with the browser, and return the answer."""
    is_secure = request.url.scheme == "https"
    response.set_cookie(cookie_name(request), token, httponly=True, samesite="strict", path="/", secure=is_secure)
    return _answer(authenticator, authenticator.logins.user(token))


def _answer(authenticator: Authenticator, user: User | None) -> LoginAnswer:
    needs_setup = user is None and not authenticator.users.has_begun
    return LoginAnswer(user=user and user_answer(user), needs_setup=needs_setup, idle_s=IDLE_LOCK_S)


def user_answer(user: User) -> UserAnswer:
    """Return a user with the roles in their order."""
    return UserAnswer(name=user.name, roles=[role for role in ROLES if role in user.roles], is_demo=user.is_demo)
