"""Logins of signed-in users: random tokens, stored as digests, with idle lock and an end; revocable on the server."""

import hashlib
import secrets
from dataclasses import dataclass
from threading import Lock

from device.clock import Clock
from services.errors import ConfirmationRequired, LoginRequired
from services.identity.users import User, UserTable

IDLE_LOCK_S = 300.0
MAX_LOGIN_S = 12 * 3600.0
CONFIRMED_S = 300.0  # after typing the secret, actions with a risk need no further confirmation
MAX_LOGINS = 20  # of one user; the oldest end first


@dataclass
class _Login:
    name: str
    generation: int
    begun_s: float
    used_s: float
    confirmed_s: float


class Logins:
    """Logins by token. Thread-safe; they end with the process.

    A login ends `IDLE_LOCK_S` after the last request that acts, `MAX_LOGIN_S` after its start, and at once when its
    user is removed or changed.
    """

    def __init__(self, users: UserTable, clock: Clock) -> None:
        self._users, self._clock = users, clock
        self._lock = Lock()
        self._logins: dict[str, _Login] = {}

    def begin(self, user: User) -> str:
        """Begin a login of a user whose secret was verified, and return its token (256 random bits)."""
        token, now_s = secrets.token_urlsafe(32), self._clock.now_s()
        with self._lock:
            self._logins[_digest(token)] = _Login(user.name, user.generation, now_s, now_s, now_s)
            of_user = [digest for digest, login in self._logins.items() if login.name == user.name]
            for oldest in of_user[:-MAX_LOGINS]:
                del self._logins[oldest]
        return token

    def user(self, token: str | None, acts: bool = False) -> User | None:
        """Return the user of a login, None for an unknown, expired or revoked one; `acts` restarts the idle lock."""
        login = self._live(token)
        if login is None:
            return None
        user = self._users.find(login.name)
        if user is None or user.generation != login.generation:
            self.end(token)
            return None
        if acts:
            login.used_s = self._clock.now_s()
        return user

    def require_confirmed(self, token: str | None) -> None:
        """Raise ConfirmationRequired unless the secret was typed within `CONFIRMED_S`, LoginRequired if it ended."""
        login = self._live(token)
        if login is None:
            raise LoginRequired("the login has ended")
        if self._clock.now_s() - login.confirmed_s >= CONFIRMED_S:
            raise ConfirmationRequired("the PIN was typed too long ago")

    def confirm(self, token: str | None) -> None:
        """Note that the user of a login has typed the secret again."""
        if (login := self._live(token)) is not None:
            login.confirmed_s = login.used_s = self._clock.now_s()

    def end(self, token: str | None) -> None:
        """End a login; no effect on an unknown one."""
        with self._lock:
            self._logins.pop(_digest(token or ""), None)

    def _live(self, token: str | None) -> _Login | None:
        now_s = self._clock.now_s()
        with self._lock:
            login = self._logins.get(_digest(token or ""))
            if login is None:
                return None
            if now_s - login.used_s >= IDLE_LOCK_S or now_s - login.begun_s >= MAX_LOGIN_S:
                del self._logins[_digest(token or "")]
                return None
            return login


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "backslashreplace")).hexdigest()
