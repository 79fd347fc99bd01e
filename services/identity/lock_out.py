"""Lock-out after wrong secrets, by account and by address: exponential backoff that survives a restart."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from pydantic import BaseModel

from device import atomic_io
from device.clock import Clock
from services.records import digested_json

log = logging.getLogger(__name__)

FILE = "lock-out.json"
MAX_WAIT_S, MAX_OWN_SCREEN_WAIT_S = 300.0, 60.0
FORGOTTEN_S = 86_400.0
MAX_ENTRIES = 500  # the oldest go first
_Pair = tuple[str, str]  # account and address


class _Content(BaseModel):
    failures: tuple[tuple[str, str, int], ...]
    known: tuple[_Pair, ...]


@dataclass
class _Failures:
    count: int
    last_s: float


class LockOut:
    """Wrong attempts by account and address, in a file of `folder`. Thread-safe.

    After n wrong attempts for one account, or from one address, the next has to wait 2^(n-1) s, at most `MAX_WAIT_S`;
    at the device's own screen at most `MAX_OWN_SCREEN_WAIT_S`. An address from which an account signed in has its own
    count for it, so that no other client keeps its user out there. A restart keeps the counts and begins each wait
    again: no step of the clock shortens one. An unreadable file is a full wait for everybody.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file, self._clock = folder / FILE, clock
        self._lock = Lock()
        self._failures: dict[_Pair, _Failures] = {}
        self._known: dict[_Pair, None] = {}  # accounts that signed in, and from which address; the latest is the last
        self._is_damaged = self._read()
        self._begun_s = clock.now_s()

    def wait_s(self, account: str, address: str, is_own_screen: bool) -> float:
        """Return the seconds until the next attempt for this account from this address; 0 if it is permitted now."""
        limit_s = MAX_OWN_SCREEN_WAIT_S if is_own_screen else MAX_WAIT_S
        now_s = self._clock.now_s()
        with self._lock:
            is_known, every = (account, address) in self._known, self._failures.items()
            of_account = [one for key, one in every if key[0] == account and (key[1] == address or not is_known)]
            of_address = [one for key, one in every if key[1] == address]
            ends_s = [_end_s(of_account, limit_s), _end_s(of_address, limit_s)]
            if self._is_damaged:
                ends_s.append(self._begun_s + limit_s)
        return max(0.0, *(end_s - now_s for end_s in ends_s))

    def record_failure(self, account: str, address: str) -> None:
        """Count one wrong attempt, durably where the disk takes it."""
        now_s = self._clock.now_s()
        with self._lock:
            recent = {key: one for key, one in self._failures.items() if now_s - one.last_s < FORGOTTEN_S}
            before = recent.pop((account, address), None)
            recent[account, address] = _Failures((before.count if before else 0) + 1, now_s)
            self._failures = dict(list(recent.items())[-MAX_ENTRIES:])
            self._write()

    def record_success(self, account: str, address: str) -> None:
        """Forget the wrong attempts for an account from this address, from which it has its own count from now on."""
        with self._lock:
            pair = account, address
            changed = self._failures.pop(pair, None) is not None or pair not in self._known
            self._known.pop(pair, None)
            self._known[pair] = None
            self._known = dict.fromkeys(list(self._known)[-MAX_ENTRIES:])
            if changed:
                self._write()

    def _read(self) -> bool:
        """Take the counts of the file; return whether it cannot be read."""
        now_s = self._clock.now_s()
        try:
            content = _Content.model_validate(digested_json.decoded(self._file.read_bytes()))
        except FileNotFoundError:
            return False
        except (OSError, ValueError) as error:
            log.warning("the wrong attempts to sign in cannot be read: %s", error)
            return True
        self._failures = {(account, at): _Failures(count, now_s) for account, at, count in content.failures}
        self._known = dict.fromkeys(content.known)
        return False

    def _write(self) -> None:
        failures = tuple((*pair, one.count) for pair, one in self._failures.items())
        content = _Content(failures=failures, known=tuple(self._known))
        try:
            atomic_io.make_private(self._file.parent)
            atomic_io.write_atomically(self._file, digested_json.encoded(content.model_dump(mode="json")))
        except OSError as error:  # the count of this process is in force all the same
            log.warning("the wrong attempts to sign in cannot be stored: %s", error)


def _end_s(failures: Iterable[_Failures], limit_s: float) -> float:
    """Return the time at which the wait after these wrong attempts ends; 0 without any."""
    several = list(failures)
    if not several:
        return 0.0
    count = sum(one.count for one in several)
    return max(one.last_s for one in several) + min(2.0 ** min(count - 1, 32), limit_s)
