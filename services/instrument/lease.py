"""One screen at a time takes pictures: a lease that its holder renews with every request, and that others may take."""

import hashlib
from dataclasses import dataclass
from threading import Lock

from device.clock import Clock
from device.errors import OtherScreen

LASTS_S = 10.0
RELOAD_S = 2.0  # a page that leaves may only be loading itself anew


@dataclass(frozen=True)
class Held:
    """Who holds the instrument: its public name (None: nobody), and whether that is who asks."""

    lease: str | None
    mine: bool


class Lease:
    """Held by a screen's secret key, known to others by a name made from it; ends 10 s after its last request.

    Sooner where it was let go.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self._lock = clock, Lock()
        self._key, self._until_s = "", 0.0

    @property
    def holder(self) -> str | None:
        """The public name of who holds it now; None if nobody does."""
        with self._lock:
            return _name(self._key) if self._is_live() else None

    def ask(self, key: str, take: bool = False) -> Held:
        """Get it if it is free, or take it from whoever holds it."""
        with self._lock:
            mine = take or not self._is_live() or key == self._key
            if mine:
                self._hold(key)
            return Held(_name(self._key), mine)

    def release(self, key: str) -> Held:
        """This screen closes: whoever asks may have it a moment later, unless it is back by then."""
        with self._lock:
            if self._is_live() and key == self._key:
                self._until_s = min(self._until_s, self._clock.now_s() + RELOAD_S)
            return Held(_name(self._key), False)

    def touch(self, key: str) -> None:
        """A request of this screen: if it holds the lease, that goes on."""
        with self._lock:
            if self._is_live() and key == self._key:
                self._hold(key)

    def check(self, key: str | None) -> None:
        """Before something is changed: OtherScreen if another holds it. Without a key a script, or the button, asks."""
        if key is not None and not self.ask(key).mine:
            raise OtherScreen("another screen holds the camera")

    def _is_live(self) -> bool:
        return self._clock.now_s() < self._until_s

    def _hold(self, key: str) -> None:
        self._key, self._until_s = key, self._clock.now_s() + LASTS_S


def _name(key: str) -> str:
    return hashlib.sha256(key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
