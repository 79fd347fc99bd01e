"""Authentication of users: sign-in with lock-out, set-up of an administrator, the demonstration user."""

from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from starlette.requests import HTTPConnection

from device.clock import Clock
from device.errors import StoreError
from services.errors import PresenceRequired, SecretWrong, SetupRequired, SignInLockedOut
from services.http.client_limits import Client
from services.identity.lock_out import LockOut
from services.identity.logins import Logins
from services.identity.setup_code import SetupCode
from services.identity.users import User, UserTable

# The user of a simulated head before the first real user; only a real administrator changes users.
DEMO_USER = User("Demo", frozenset({"screener", "reader", "technician"}), is_demo=True)
PROXY_HEADERS = ("forwarded", "via", "x-forwarded-for")
CODE_REMEDY = "A code is valid for two minutes and five tries. `diffuscope label` on the device makes a new one."
PRESSED_S = 30.0  # in which a press of the button shows that the user is at the device
OWN_SCREEN_REMEDY = "Open this page on the screen of the device itself: its button cannot be read."
SETUP_ACCOUNT, UNKNOWN_ACCOUNT = "set-up", "unknown"


@dataclass(frozen=True)
class Peer:
    """Client of a request: its address, and whether it is the device itself (loopback, and no proxy between)."""

    address: str
    is_own_screen: bool

    @classmethod
    def of(cls, request: HTTPConnection) -> "Peer":
        """Return the client of a request."""
        client = Client.at(request.client.host if request.client is not None else "")
        is_own = client.is_local and not any(name in request.headers for name in PROXY_HEADERS)
        return OWN_SCREEN if is_own else cls(client.address, False)


OWN_SCREEN = Peer("own screen", True)


class Authenticator:
    """Users, their logins and the lock-out of one data folder. Thread-safe.

    `has_demo`: until the first user is created, requests from the device itself are those of `DEMO_USER`. `refusal`: as
    of `UserTable`. `tls`: folder of the set-up code.
    """

    def __init__(
        self,
        folder: Path,
        clock: Clock,
        has_demo: bool = False,
        refusal: StoreError | None = None,
        tls: Path | None = None,
    ) -> None:
        self._setup_code = SetupCode(tls or folder, clock, folder)
        self.users = UserTable(folder, refusal)
        self.logins = Logins(self.users, clock)
        self._lock_out = LockOut(folder, clock)
        self._has_demo = has_demo
        self._verifying = Lock()  # one attempt after the other: each is counted before the next is judged

    def user(self, token: str | None, peer: Peer, acts: bool = False) -> User | None:
        """Return the user of a request, None if none is signed in; `acts` restarts the idle lock."""
        if not self.users.has_begun:
            return DEMO_USER if self._has_demo and peer.is_own_screen else None
        return self.logins.user(token, acts)

    def wait_s(self, name: str, peer: Peer) -> float:
        """Return the seconds until the next attempt to sign in with this name; 0 if it is permitted now."""
        return self._lock_out.wait_s(self._account(name), peer.address, peer.is_own_screen)

    def sign_in(self, name: str, secret: str, peer: Peer) -> str:
        """Begin a login and return its token; SecretWrong, SignInLockedOut, or SetupRequired before the first user."""
        if not self.users.has_begun:
            raise SetupRequired("no user exists yet")
        return self.logins.begin(self._verified(name, secret, peer))

    def confirm(self, token: str | None, secret: str, peer: Peer) -> None:
        """Note that the user of a login has typed the secret again; SecretWrong or SignInLockedOut otherwise."""
        self._verified(self._own_name(token), secret, peer)
        self.logins.confirm(token)

    def change_secret(self, token: str | None, secret: str, new: str, peer: Peer) -> str:
        """Give the user of a login a new secret; return the token of the login that replaces all earlier ones.

        SecretWrong or SignInLockedOut; LoginRequired if an administrator has changed the user meanwhile.
        """
        user = self._verified(self._own_name(token), secret, peer)
        return self.logins.begin(self.users.change(user.name, secret=new, generation=user.generation))

    def set_up(self, code: str, name: str, secret: str, peer: Peer, pressed_s: float | None) -> str:
        """Create an administrator, who has every role, or give the one of that name a new secret; return a login token.

        `pressed_s`: time since the button of the head was pressed, None if none can be read. PresenceRequired with
        users if that is too long ago, or without a button for another screen than the own one. SecretWrong for a wrong
        or used code, SignInLockedOut, InputError for the secret or the name, as that of a user without administration.
        """
        with self._verifying:
            if self.users.has_begun:  # before the code: who is elsewhere can neither try one nor end it
                check_presence(peer, pressed_s)
            self._refuse_early(SETUP_ACCOUNT, peer)
            if not self._setup_code.is_valid(code):
                self._lock_out.record_failure(SETUP_ACCOUNT, peer.address)
                raise SecretWrong("this is not the set-up code", CODE_REMEDY)
            user = self._administrator(name, secret)
            self._setup_code.end()
            self._lock_out.record_success(SETUP_ACCOUNT, peer.address)
        return self.logins.begin(user)

    def _administrator(self, name: str, secret: str) -> User:
        user = self.users.find(name)
        if user is None or "administrator" not in user.roles:
            return self.users.add(name, secret, DEMO_USER.roles | {"administrator"})
        return self.users.change(name, secret=secret, generation=user.generation)

    def _own_name(self, token: str | None) -> str:
        user = self.logins.user(token)
        return "" if user is None else user.name

    def _verified(self, name: str, secret: str, peer: Peer) -> User:
        with self._verifying:
            account = self._account(name)
            self._refuse_early(account, peer)
            user = self.users.verify(name, secret)
            if user is None:
                self._lock_out.record_failure(account, peer.address)
                raise SecretWrong("name and PIN do not belong together")
            self._lock_out.record_success(account, peer.address)
            return user

    def _refuse_early(self, account: str, peer: Peer) -> None:
        wait_s = self._lock_out.wait_s(account, peer.address, peer.is_own_screen)
        if wait_s > 0:
            raise SignInLockedOut(f"wrong several times: wait {wait_s:.0f} s", wait_s=round(wait_s, 1))

    def _account(self, name: str) -> str:
        """Return the account of the lock-out: a new secret begins a new one, all unknown names share one."""
        user = self.users.find(name)
        return UNKNOWN_ACCOUNT if user is None else f"{user.name} {user.generation}"


def check_presence(peer: Peer, pressed_s: float | None) -> None:
    """Raise PresenceRequired unless the user is at the device.

    `pressed_s`: time since the button of the head was pressed, None if none can be read: then the own screen counts.
    """
    if pressed_s is None and not peer.is_own_screen:
        raise PresenceRequired("this needs a user at the device", OWN_SCREEN_REMEDY)
    if pressed_s is not None and pressed_s > PRESSED_S:
        raise PresenceRequired("the button of the camera was not pressed")
