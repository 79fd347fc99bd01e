"""PIN authentication: scrypt hash, lock-out with exponential backoff, one login token with idle timeout."""

import hashlib
import hmac
import secrets
from pathlib import Path
from threading import Lock

from device import atomic_io
from device.clock import Clock
from device.errors import StoreError
from services.errors import LoginRequired, PinLockedOut, PinWrong, StoreDamaged
from services.records import digested_json

MIN_DIGITS, MAX_DIGITS = 4, 12  # digits
IDLE_TIMEOUT_S = 300.0
MAX_LOCK_OUT_S = 300.0
SCRYPT_COST: dict[str, int] = {"n": 2**14, "r": 8, "p": 1}  # scrypt: 16 MB and about 50 ms per guess


class PinAuthenticator:
    """PIN authentication with one login at a time; only a salted scrypt hash of the PIN is stored, in `file`.

    The first `set_pin` needs no login. A login issues a token, which expires after `IDLE_TIMEOUT_S` without
    `renew_login` and at the next login. Lock-out: after n wrong PINs in a row further tries are refused for 2^(n-1) s,
    at most `MAX_LOCK_OUT_S`. Comparisons take constant time. Thread-safe.
    """

    def __init__(self, file: Path, clock: Clock) -> None:
        self._file, self._clock = file, clock
        self._lock = Lock()
        self._token: str | None = None
        self._touched_s = 0.0
        self._wrong = 0
        self._not_before_s = 0.0

    @property
    def has_pin(self) -> bool:
        """Whether a PIN has been set."""
        return self._file.exists()

    @property
    def lock_out_s(self) -> float:
        """Seconds until the next try is allowed; 0 if it is allowed now."""
        return max(0.0, self._not_before_s - self._clock.now_s())

    def set_pin(self, pin: str, token: str | None) -> str:
        """Set the PIN and log in; return the login token. Changing an existing PIN requires a valid token.

        LoginRequired without that token, PinWrong if it is not 4 to 12 digits, StoreError if it cannot be written.
        """
        with self._lock:
            if self.has_pin:
                self._require_login(token)
            if not (pin.isascii() and pin.isdecimal() and MIN_DIGITS <= len(pin) <= MAX_DIGITS):
                raise PinWrong("this cannot be a PIN", f"Choose {MIN_DIGITS} to {MAX_DIGITS} digits.")
            salt = secrets.token_bytes(16)
            content = digested_json.encoded({"salt": salt.hex(), "hash": _hash(pin, salt).hex()})
            try:
                atomic_io.write_atomically(self._file, content)
            except OSError as error:
                raise StoreError(f"the PIN cannot be kept: {error}", "Free some space, then set it again.") from error
            return self._issue_token()

    def log_in(self, pin: str) -> str:
        """Log in with the PIN and return the login token.

        PinWrong for a wrong PIN, PinLockedOut during the lock-out (the PIN is not checked), LoginRequired before a PIN
        is set, StoreDamaged if its file is damaged.
        """
        with self._lock:
            if not self.has_pin:
                raise LoginRequired("no PIN was set yet", "Choose a PIN first.")
            if (wait_s := self.lock_out_s) > 0:
                raise PinLockedOut(f"{self._wrong} wrong PINs in a row: wait {wait_s:.0f} s")
            salt, known = self._read_hash()
            if not hmac.compare_digest(_hash(pin, salt), known):
                self._wrong += 1
                self._not_before_s = self._clock.now_s() + min(2.0 ** (self._wrong - 1), MAX_LOCK_OUT_S)
                raise PinWrong("this is not the PIN")
            return self._issue_token()

    def log_out(self) -> None:
        """Log out: invalidate the login token."""
        with self._lock:
            self._token = None

    def require_login(self, token: str | None) -> None:
        """Raise LoginRequired unless `token` is the valid login token."""
        with self._lock:
            self._require_login(token)

    def is_logged_in(self, token: str | None) -> bool:
        """Return whether `token` is the valid login token."""
        try:
            self.require_login(token)
        except LoginRequired:
            return False
        return True

    def renew_login(self, token: str | None) -> None:
        """Check the token and restart the idle timeout; LoginRequired if the token is invalid.

        Called for requests that act; requests that only read leave the timeout running.
        """
        with self._lock:
            self._require_login(token)
            self._touched_s = self._clock.now_s()

    def _require_login(self, token: str | None) -> None:
        if self._token is not None and self._clock.now_s() - self._touched_s >= IDLE_TIMEOUT_S:
            self._token = None
        if self._token is None or token is None or not hmac.compare_digest(token.encode(), self._token.encode()):
            raise LoginRequired("the technician's place is locked")

    def _issue_token(self) -> str:
        self._wrong = 0
        self._not_before_s = 0.0
        self._token, self._touched_s = secrets.token_urlsafe(32), self._clock.now_s()
        return self._token

    def _read_hash(self) -> tuple[bytes, bytes]:
        try:
            stored = digested_json.decoded(self._file.read_bytes())
            return bytes.fromhex(str(stored["salt"])), bytes.fromhex(str(stored["hash"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            message = f"the file with the technician's PIN is damaged: {error}"
            raise StoreDamaged(message, f"Remove {self._file} and choose a new PIN.") from error


def _hash(pin: str, salt: bytes) -> bytes:
    return hashlib.scrypt(pin.encode("utf-8"), salt=salt, dklen=32, **SCRYPT_COST)
