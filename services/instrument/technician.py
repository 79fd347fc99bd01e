"""The technician's door: a PIN of which only a hash is kept, growing waits for who guesses, shut again when idle."""

import hashlib
import hmac
import json
import secrets
from pathlib import Path
from threading import Lock
from typing import Any

from device.calibration.archive import sync_folder, write_synced
from device.clock import Clock
from device.errors import PinTooSoon, PinWrong, StoreDamaged, StoreError, TechnicianLocked

FEWEST, MOST = 4, 12  # digits
IDLE_S = 300.0
LONGEST_WAIT_S = 300.0
COST: dict[str, Any] = {"n": 2**14, "r": 8, "p": 1}  # 16 MB and about 50 ms for each guess


class Door:
    """Opens for the PIN whose hash is in `file`; the first PIN that is given sets it.

    Whoever came in holds a token, which is worth nothing after `IDLE_S` without `touch`, or when another came in. After
    n wrong PINs in a row the next try has to wait 2^(n-1) seconds, at most `LONGEST_WAIT_S`.
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
        """Whether a PIN was ever set."""
        return self._file.exists()

    @property
    def wait_s(self) -> float:
        """Seconds until the next try is allowed; 0 if it is now."""
        return max(0.0, self._not_before_s - self._clock.now_s())

    def set_pin(self, pin: str, token: str | None) -> str:
        """Keep a PIN, and be inside with it: the token. Where there is one already, only from inside."""
        with self._lock:
            if self.has_pin:
                self._refuse_strangers(token)
            if not (pin.isascii() and pin.isdecimal() and FEWEST <= len(pin) <= MOST):
                raise PinWrong("this cannot be a PIN", f"Choose {FEWEST} to {MOST} digits.")
            salt = secrets.token_bytes(16)
            content = json.dumps({"salt": salt.hex(), "hash": _hash(pin, salt).hex()}).encode("ascii")
            part = self._file.with_name(f".{self._file.name}")
            try:
                part.touch(mode=0o600)
                write_synced(part, content)
                part.replace(self._file)
                sync_folder(self._file.parent)
            except OSError as error:
                raise StoreError(f"the PIN cannot be kept: {error}", "Free some space, then set it again.") from error
            return self._let_in()

    def unlock(self, pin: str) -> str:
        """The token for a right PIN; PinWrong, or PinTooSoon without a look at it."""
        with self._lock:
            if not self.has_pin:
                raise TechnicianLocked("no PIN was set yet", "Choose a PIN first.")
            if (wait_s := self.wait_s) > 0:
                raise PinTooSoon(f"{self._wrong} wrong PINs in a row: wait {wait_s:.0f} s")
            salt, known = self._kept()
            if not hmac.compare_digest(_hash(pin, salt), known):
                self._wrong += 1
                self._not_before_s = self._clock.now_s() + min(2.0 ** (self._wrong - 1), LONGEST_WAIT_S)
                raise PinWrong("this is not the PIN")
            return self._let_in()

    def lock(self) -> None:
        """Nobody is inside any more."""
        self._token = None

    def refuse_strangers(self, token: str | None) -> None:
        """TechnicianLocked unless this is the token of who is inside."""
        with self._lock:
            self._refuse_strangers(token)

    def knows(self, token: str | None) -> bool:
        """Whether this is the token of who is inside."""
        try:
            self.refuse_strangers(token)
        except TechnicianLocked:
            return False
        return True

    def touch(self, token: str | None) -> None:
        """The technician does something: the door stays open for another while. Looking on is not enough."""
        with self._lock:
            self._refuse_strangers(token)
            self._touched_s = self._clock.now_s()

    def _refuse_strangers(self, token: str | None) -> None:
        if self._token is not None and self._clock.now_s() - self._touched_s >= IDLE_S:
            self._token = None
        if self._token is None or token is None or not hmac.compare_digest(token.encode(), self._token.encode()):
            raise TechnicianLocked("the technician's place is locked")

    def _let_in(self) -> str:
        self._wrong, self._not_before_s = 0, 0.0
        self._token, self._touched_s = secrets.token_urlsafe(32), self._clock.now_s()
        return self._token

    def _kept(self) -> tuple[bytes, bytes]:
        try:
            said = json.loads(self._file.read_bytes())
            return bytes.fromhex(said["salt"]), bytes.fromhex(said["hash"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            said_file = f"the file with the technician's PIN is damaged: {error}"
            raise StoreDamaged(said_file, f"Remove {self._file} and choose a new PIN.") from error


def _hash(pin: str, salt: bytes) -> bytes:
    return hashlib.scrypt(pin.encode("utf-8"), salt=salt, dklen=32, **COST)
