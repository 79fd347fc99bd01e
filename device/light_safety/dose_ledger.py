"""Dose ledger: the retinal light dose of each eye, and the dose that it may still receive.

A dose ages only by time that the running instrument has measured itself: not by the date, which can be set, and not
while the device is off. So no clock jump can expire a dose early. The cost is that a dose counts for longer than a day
on a device that is not always on; the limits leave a margin for that (decisions/).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from math import ceil
from typing import Protocol

from device.clock import Clock
from device.errors import DailyLightLimit, LightLimit
from device.values import Eye

LONGEST_REST_S = 3 * 3600.0  # after a longer wait DailyLightLimit is raised: the light of the day is spent
INTERVAL_S = (
    600.0  # doses are summed by interval, so that the ledger stays short; each counts until its last dose expires
)


@dataclass(frozen=True)
class Reserved:
    """Reservation: `dose_j_per_cm2` for each of `eyes`, counted in interval number `interval` before its delivery."""

    eyes: tuple[Eye, ...]
    interval: int
    dose_j_per_cm2: float


class Ledger(Protocol):
    """Protocol of a dose ledger; the stored one returns from `reserve` only once the reservation is durable on disk."""

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """Return the dose of an eye in the window of the ledger, J/cm2, including unsettled reservations."""

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose before delivery; LightLimit if the total of an eye would exceed the stop, StoreError."""

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Replace a reservation by the delivered dose, J/cm2; after StoreError the whole reservation stays counted."""


@dataclass
class DoseLedgerState:
    """State of the dose ledger: doses, J/cm2, by eye and interval number, and the observed time, s.

    `observed_s` grows only by differences of the monotonic clock within one boot, never by the date; `boot` and `now_s`
    are the boot id and the clock reading of the last `advance`.
    """

    doses: dict[tuple[Eye, int], float] = field(default_factory=dict)
    observed_s: float = 0.0
    boot: str = ""
    now_s: float = 0.0

    def advance(self, boot: str, now_s: float, window_s: float) -> None:
        """Add the time since the last call (nothing after a reboot), and delete the intervals that no longer count."""
        self.observed_s = self.observed_at_s(boot, now_s)
        self.boot, self.now_s = boot, now_s
        for eye, interval in [key for key in self.doses if self.left_s(key[1], window_s) <= 0]:
            del self.doses[eye, interval]

    def observed_at_s(self, boot: str, now_s: float) -> float:
        """Return the observed time, s, at the clock reading `now_s` of that boot."""
        return self.observed_s + (max(0.0, now_s - self.now_s) if boot == self.boot else 0.0)

    def left_s(self, interval: int, window_s: float) -> float:
        """Return for how long an interval still counts, s, with one more for light that continued past its end."""
        return (interval + 2) * INTERVAL_S + window_s - self.observed_s

    def spent(self, eye: Eye) -> float:
        """Return the total dose of an eye over all intervals, J/cm2."""
        return sum(dose for (whose, _), dose in self.doses.items() if whose == eye)

    def wait_s(self, eye: Eye, dose_j_per_cm2: float, stop_j_per_cm2: float, window_s: float) -> float:
        """Return the time, s, until an eye may receive a dose: 0 now, infinite if the dose alone exceeds the stop."""
        total = self.spent(eye) + dose_j_per_cm2
        if total <= stop_j_per_cm2:
            return 0.0
        for interval in sorted(interval for whose, interval in self.doses if whose == eye):
            total -= self.doses[eye, interval]
            if total <= stop_j_per_cm2:
                return self.left_s(interval, window_s)
        return float("inf")

    def add(self, eyes: Iterable[Eye], interval: int, dose_j_per_cm2: float) -> None:
        """Add a dose, J/cm2, to interval number `interval` of these eyes; a negative dose is subtracted, down to 0."""
        for eye in eyes:
            self.doses[eye, interval] = max(0.0, self.doses.get((eye, interval), 0.0) + dose_j_per_cm2)

    def reserve(
        self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float, window_s: float, wall: datetime
    ) -> Reserved:
        """Count a dose for all eyes; if any exceeds the stop, count none: LightLimit with the next permitted time."""
        for eye in eyes:
            wait_s = self.wait_s(eye, dose_j_per_cm2, stop_j_per_cm2, window_s)
            if wait_s > 0:
                raise limit_error(eye, self.spent(eye), stop_j_per_cm2, wait_s, wall)
        reserved = Reserved(tuple(eyes), int(self.observed_s // INTERVAL_S), dose_j_per_cm2)
        self.add(reserved.eyes, reserved.interval, dose_j_per_cm2)
        return reserved

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Replace a reservation by the delivered dose, J/cm2; an interval that no longer counts is not changed."""
        counted = [eye for eye in reserved.eyes if (eye, reserved.interval) in self.doses]
        self.add(counted, reserved.interval, given_j_per_cm2 - reserved.dose_j_per_cm2)


def limit_error(eye: Eye, spent_j_per_cm2: float, stop_j_per_cm2: float, wait_s: float, wall: datetime) -> LightLimit:
    """Return the error for this eye, with the local time (`wall` plus `wait_s`) at which light is allowed again.

    DailyLightLimit if the wait is above LONGEST_REST_S (3 h), else LightLimit. For an infinite `wait_s`, LightLimit
    without a time: one exposure alone exceeds the limit.
    """
    name = {"OD": "the right eye", "OS": "the left eye"}[eye]
    if wait_s == float("inf"):
        return LightLimit(
            f"one exposure would be more than the {stop_j_per_cm2:.3g} J/cm2 that {name} may have in a day",
            "Choose a dimmer light or another colour.",
        )
    now = wall.astimezone()
    minutes = ceil(wait_s / 60)
    then = now + timedelta(minutes=minutes)
    when = f"{then:%H:%M}" if then.date() == now.date() else f"{then:%H:%M on %Y-%m-%d}"
    kind = DailyLightLimit if wait_s > LONGEST_REST_S else LightLimit
    return kind(
        f"{name} has had {spent_j_per_cm2:.3g} of {stop_j_per_cm2:.3g} J/cm2; light is allowed again after {when}",
        f"Let this eye rest until {when}. The device must stay on: time counts only while it does.",
        n=minutes,
    )


class MemoryLedger:
    """Dose ledger in memory, for tests and for tools that light no eye; not durable."""

    def __init__(
        self, clock: Clock, window_s: float = 86400.0, state: DoseLedgerState | None = None, boot: str = "this"
    ) -> None:
        self._clock = clock
        self._window_s = window_s
        self._boot = boot
        self.state = state or DoseLedgerState()
        self._advanced()

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """Return the dose of an eye in the window of the ledger, J/cm2, including unsettled reservations."""
        return self._advanced().spent(eye)

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose before it is delivered; LightLimit if the total of an eye would exceed the stop."""
        return self._advanced().reserve(eyes, dose_j_per_cm2, stop_j_per_cm2, self._window_s, self._clock.wall())

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Replace a reservation by the delivered dose, J/cm2."""
        self._advanced().settle(reserved, given_j_per_cm2)

    def _advanced(self) -> DoseLedgerState:
        self.state.advance(self._boot, self._clock.now_s(), self._window_s)
        return self.state
