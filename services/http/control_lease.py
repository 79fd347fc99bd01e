"""Control lease: one screen at a time may take pictures; its requests renew the lease, others may take it."""

import hashlib
from dataclasses import dataclass
from threading import Lock

from device.clock import Clock
from services.errors import ControlLeaseHeld

LEASE_S = 10.0
RELEASE_DELAY_S = 2.0  # a page that closes may only be reloading


@dataclass(frozen=True)
class LeaseState:
    """State of the control lease: public name of its present or last holder, and whether the caller holds it now."""

    lease: str | None
    mine: bool


class ControlLease:
    """Control lease, held by a screen's secret key; expires `LEASE_S` after the holder's last request.

    Other screens see a public name: the first 12 hexadecimal digits of the key's SHA-256. Thread-safe.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = Lock()
        self._key = ""
        self._until_s = 0.0

    @property
    def holder(self) -> str | None:
        """Public name of the current holder; None if the lease is free."""
        with self._lock:
            return _name(self._key) if self._is_live() else None

    def acquire(self, key: str, take: bool = False) -> LeaseState:
        """Acquire or renew the lease if it is free or held by `key`, with `take` in any case; return its state."""
        with self._lock:
            mine = take or not self._is_live() or key == self._key
            if mine:
                self._hold(key)
            return LeaseState(_name(self._key), mine)

    def release(self, key: str) -> LeaseState:
        """Let a lease held by `key` expire after `RELEASE_DELAY_S` unless `key` renews it (a reload); return its state.

        The state has `mine` False in every case.
        """
        with self._lock:
            if self._is_live() and key == self._key:
                self._until_s = min(self._until_s, self._clock.now_s() + RELEASE_DELAY_S)
            return LeaseState(_name(self._key), False)

    def renew(self, key: str) -> None:
        """Extend the lease to `LEASE_S` from now if `key` holds it."""
        with self._lock:
            if self._is_live() and key == self._key:
                self._hold(key)

    def acquire_or_refuse(self, key: str | None) -> None:
        """Acquire or renew the lease for a changing request; ControlLeaseHeld if another screen holds it.

        A request without a key (a script) passes.
        """
        if key is not None and not self.acquire(key).mine:
            raise ControlLeaseHeld("another screen holds the camera")

    def acquire_for_light(self, key: str | None) -> None:
        """Acquire or renew the lease for a request that lights the lamp; ControlLeaseHeld if another screen holds it.

        A request without a key passes only while no screen holds the lease.
        """
        if key is None and self.holder is not None:
            raise ControlLeaseHeld("a screen holds the camera")
        self.acquire_or_refuse(key)

    def _is_live(self) -> bool:
        return self._clock.now_s() < self._until_s

    def _hold(self, key: str) -> None:
        self._key, self._until_s = key, self._clock.now_s() + LEASE_S


def _name(key: str) -> str:
    return hashlib.sha256(key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
