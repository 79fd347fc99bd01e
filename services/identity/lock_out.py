"""Lock-out after wrong secrets, by account and by address: exponential backoff that survives a restart."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from pydantic import TypeAdapter

from device import atomic_io
from device.clock import Clock
from services.records import digested_json
from services.records.json_values import JsonValue

log = logging.getLogger(__name__)

FILE = "lock-out.json"
MAX_WAIT_S, MAX_OWN_SCREEN_WAIT_S = 300.0, 60.0
FORGOTTEN_S = 86_400.0
MAX_ENTRIES = 500  # the oldest go first
_ROWS = TypeAdapter(list[tuple[str, str, int]])  # account, address, wrong attempts


@dataclass
class _Failures:
    count: int
    last_s: float


class LockOut:
    """Wrong attempts by account and address, in a file of `folder`. Thread-safe.

    After n wrong attempts for one account, or from one address, the next has to wait 2^(n-1) s, at most `MAX_WAIT_S`;
    at the device's own screen at most `MAX_OWN_SCREEN_WAIT_S`, so that a remote client cannot keep its users out. A
    restart keeps the counts and begins each wait again: no step of the clock shortens one. An unreadable file is a full
    wait for everybody.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file, self._clock = folder / FILE, clock
        self._lock = Lock()
        self._failures, self._is_damaged = self._read()
        self._begun_s = clock.now_s()

    def wait_s(self, account: str, address: str, is_own_screen: bool) -> float:
        """Return the seconds until the next attempt for this account from this address; 0 if it is permitted now."""
        limit_s = MAX_OWN_SCREEN_WAIT_S if is_own_screen else MAX_WAIT_S
        now_s = self._clock.now_s()
        with self._lock:
            of_account = [failures for key, failures in self._failures.items() if key[0] == account]
            of_address = [failures for key, failures in self._failures.items() if key[1] == address]
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
        """Forget the wrong attempts for an account, and those from this address that were for it."""
        with self._lock:
            kept = {key: one for key, one in self._failures.items() if key[0] != account}
            changed = len(kept) < len(self._failures)
            self._failures = kept
            if changed:
                self._write()

    def _read(self) -> tuple[dict[tuple[str, str], _Failures], bool]:
        try:
            rows = _ROWS.validate_python(digested_json.decoded(self._file.read_bytes())["failures"])
        except FileNotFoundError:
            return {}, False
        except (OSError, ValueError, KeyError) as error:
            log.warning("the wrong attempts to sign in cannot be read: %s", error)
            return {}, True
        now_s = self._clock.now_s()
        return {(account, address): _Failures(count, now_s) for account, address, count in rows}, False

    def _write(self) -> None:
        rows: list[JsonValue] = [[*key, failures.count] for key, failures in self._failures.items()]
        try:
            atomic_io.make_private(self._file.parent)
            atomic_io.write_atomically(self._file, digested_json.encoded({"failures": rows}))
        except OSError as error:  # the count of this process is in force all the same
            log.warning("the wrong attempts to sign in cannot be stored: %s", error)


def _end_s(failures: Iterable[_Failures], limit_s: float) -> float:
    """Return the time at which the wait after these wrong attempts ends; 0 without any."""
    several = list(failures)
    if not several:
        return 0.0
    count = sum(one.count for one in several)
    return max(one.last_s for one in several) + min(2.0 ** min(count - 1, 32), limit_s)
