"""Endpoints of the technician's login with the PIN."""

from fastapi import APIRouter, Depends, Response

from services.http.authentication import IDLE_TIMEOUT_S, PinAuthenticator
from services.http.dependencies import COOKIE, Token, login_renewal
from services.http.schemas.technician import LoginAnswer, LoginState, Pin


def login_router(authenticator: PinAuthenticator) -> APIRouter:
    """Return the router of login, logout and PIN."""
    router = APIRouter()
    router.include_router(_pin_router(authenticator))
    router.include_router(_logged_in_router(authenticator), dependencies=[Depends(login_renewal(authenticator))])
    return router


def _pin_router(authenticator: PinAuthenticator) -> APIRouter:
    """Return the router of the endpoints that need no login."""
    router = APIRouter(prefix="/api/technician")

    def answer(response: Response, token: str) -> LoginAnswer:
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/api")
        return LoginAnswer(open=True)

    @router.get("")
    def login_state(token: Token = None) -> LoginState:
        """Return whether this client is logged in and a PIN is set, the lock-out left and the idle timeout, seconds."""
        return LoginState(
            open=authenticator.is_logged_in(token),
            has_pin=authenticator.has_pin,
            wait_s=round(authenticator.lock_out_s, 1),
            idle_s=IDLE_TIMEOUT_S,
        )

    @router.post("/pin")
    def set_pin(pin: Pin, response: Response, token: Token = None) -> LoginAnswer:
        """Set the PIN and log in.

        The first PIN needs no login, a change does (401). Sets the login cookie. 403 unless it has 4 to 12 digits.
        """
        return answer(response, authenticator.set_pin(pin.pin, token))

    @router.post("/unlock")
    def log_in(pin: Pin, response: Response) -> LoginAnswer:
        """Log in with the PIN.

        Sets the login cookie. 401 before a PIN is set, 403 for a wrong PIN, 429 during the lock-out.
        """
        return answer(response, authenticator.log_in(pin.pin))

    return router


def _logged_in_router(authenticator: PinAuthenticator) -> APIRouter:
    """Return the router of the endpoints that need a login."""
    router = APIRouter(prefix="/api/technician")

    @router.post("/here")
    def keep_login() -> LoginAnswer:
        """Restart the idle timeout, because the technician uses the page; 401 without a login."""
        return LoginAnswer(open=True)

    @router.post("/lock")
    def log_out() -> LoginAnswer:
        """Log out; 401 without a login."""
        authenticator.log_out()
        return LoginAnswer(open=False)

    return router
