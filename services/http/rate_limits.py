"""Rate limits of requests that make light, records or work: a burst at once, then one for each interval."""

from collections.abc import Mapping
from dataclasses import dataclass

from device.clock import Clock
from services.errors import TooManyRequests


@dataclass(frozen=True)
class Rate:
    """`burst` requests of one client at once, and one more for each `interval_s`."""

    burst: int
    interval_s: float


# A visit takes minutes and a picture seconds; a repeated request of a bad link counts too. Each sign-in costs one
# argon2id hash, and guesses have the lock-out beside.
SIGN_IN, VISITS, PRESSES = Rate(60, 1.0), Rate(60, 5.0), Rate(60, 1.0)
RATES = {
    "POST /api/login": SIGN_IN,
    "POST /api/login/confirm": SIGN_IN,
    "PUT /api/login/secret": SIGN_IN,
    "POST /api/setup": SIGN_IN,
    "POST /api/visits": VISITS,
    "POST /api/captures": PRESSES,
}


class RateLimits:
    """Limits of the operations in `rates`, for each client. Not thread-safe: the event loop calls it.

    Generic cell rate algorithm (ITU-T I.371): one time is kept for each client, at which its burst is full again.
    """

    def __init__(self, rates: Mapping[str, Rate], clock: Clock) -> None:
        self._rates, self._clock = rates, clock
        self._full_s: dict[tuple[str, str], float] = {}

    def count(self, operation: str, client: str) -> None:
        """Count one request; TooManyRequests, with the time to wait, beyond the limit of its operation."""
        rate = self._rates.get(operation)
        if rate is None:
            return
        now_s = self._clock.now_s()
        self._full_s = {key: full_s for key, full_s in self._full_s.items() if full_s > now_s}
        full_s = self._full_s.get((operation, client), now_s) + rate.interval_s
        wait_s = full_s - now_s - rate.burst * rate.interval_s
        if wait_s > 0:
            raise TooManyRequests("too many of these requests in a short time", wait_s=round(wait_s, 1))
        self._full_s[operation, client] = full_s
