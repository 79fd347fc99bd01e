"""The book of light: what each eye has got, and what it may still get.

A dose ages by the time that the instrument has itself seen pass, and by nothing else: not by the date, which anybody
may set, and not while it is off, when nobody counts. So no clock that jumps can forgive a dose. The price is that a
dose counts for longer than a day where the instrument is not always on; there is room for that (README, decisions).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from math import ceil
from typing import Protocol

from device.clock import Clock
from device.errors import LightDay, LightLimit
from device.values import Eye

LONGEST_REST_S = 3 * 3600.0  # nobody waits for longer: then it was the day's light
SLOT_S = 600.0  # doses are added up in slots, so that the book stays short; a slot counts until its last light may


@dataclass(frozen=True)
class Reserved:
    """Light that is counted already and may now be given: `dose_j_per_cm2` to each eye."""

    eyes: tuple[Eye, ...]
    slot: int
    dose_j_per_cm2: float


class Ledger(Protocol):
    """Who keeps the book. What `reserve` has returned is kept, whatever happens to the power or the process."""

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """What an eye has got in the window, reservations that were never settled included."""

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose before it is given; LightLimit where an eye would have more than the stop, StoreError."""

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Count what was really given instead; StoreError, and then the whole reservation stays counted."""


@dataclass
class Page:
    """The book as numbers: doses by eye and slot, and how much time was seen until a moment of a boot.

    `observed_s` grows only by what one boot's clock says between two looks at it; never by the date.
    """

    doses: dict[tuple[Eye, int], float] = field(default_factory=dict)
    observed_s: float = 0.0
    boot: str = ""
    now_s: float = 0.0

    def look(self, boot: str, now_s: float, window_s: float) -> None:
        """Let the time pass that was seen since the last look, and drop the slots that are too old to count."""
        if boot == self.boot:
            self.observed_s += max(0.0, now_s - self.now_s)
        self.boot, self.now_s = boot, now_s
        for eye, slot in [key for key in self.doses if self.left_s(key[1], window_s) <= 0]:
            del self.doses[eye, slot]

    def left_s(self, slot: int, window_s: float) -> float:
        """How long a slot still counts; the slot after it is counted in, for light that went on past its end."""
        return (slot + 2) * SLOT_S + window_s - self.observed_s

    def spent(self, eye: Eye) -> float:
        """The sum of an eye, in J/cm2."""
        return sum(dose for (whose, _), dose in self.doses.items() if whose == eye)

    def wait_s(self, eye: Eye, dose_j_per_cm2: float, stop_j_per_cm2: float, window_s: float) -> float:
        """How long until an eye may have a dose: 0 now, infinite if it is more than the stop by itself."""
        total = self.spent(eye) + dose_j_per_cm2
        if total <= stop_j_per_cm2:
            return 0.0
        for slot in sorted(slot for whose, slot in self.doses if whose == eye):
            total -= self.doses[eye, slot]
            if total <= stop_j_per_cm2:
                return self.left_s(slot, window_s)
        return float("inf")

    def add(self, eyes: Iterable[Eye], slot: int, dose_j_per_cm2: float) -> None:
        """Add a dose, or take a part of it back."""
        for eye in eyes:
            self.doses[eye, slot] = max(0.0, self.doses.get((eye, slot), 0.0) + dose_j_per_cm2)

    def reserve(
        self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float, window_s: float, wall: datetime
    ) -> Reserved:
        """Count a dose for all eyes, or refuse it for all and say until when."""
        for eye in eyes:
            wait_s = self.wait_s(eye, dose_j_per_cm2, stop_j_per_cm2, window_s)
            if wait_s > 0:
                raise refusal(eye, self.spent(eye), stop_j_per_cm2, wait_s, wall)
        reserved = Reserved(tuple(eyes), int(self.observed_s // SLOT_S), dose_j_per_cm2)
        self.add(reserved.eyes, reserved.slot, dose_j_per_cm2)
        return reserved

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Count what was given; of a slot that counts no more there is nothing left to change."""
        counted = [eye for eye in reserved.eyes if (eye, reserved.slot) in self.doses]
        self.add(counted, reserved.slot, given_j_per_cm2 - reserved.dose_j_per_cm2)


def refusal(eye: Eye, spent_j_per_cm2: float, stop_j_per_cm2: float, wait_s: float, wall: datetime) -> LightLimit:
    """No light for this eye, and when there will be some again, in the operator's time of day."""
    name = {"OD": "the right eye", "OS": "the left eye"}[eye]
    if wait_s == float("inf"):
        return LightLimit(
            f"one exposure would be more than the {stop_j_per_cm2:.3g} J/cm2 that {name} may have in a day",
            "Choose a dimmer light or another colour.",
        )
    now, minutes = wall.astimezone(), ceil(wait_s / 60)
    then = now + timedelta(minutes=minutes)
    when = f"{then:%H:%M}" if then.date() == now.date() else f"{then:%H:%M on %Y-%m-%d}"
    kind = LightDay if wait_s > LONGEST_REST_S else LightLimit
    return kind(
        f"{name} has had {spent_j_per_cm2:.3g} of {stop_j_per_cm2:.3g} J/cm2; light is allowed again after {when}",
        f"Let this eye rest until {when}. The device must stay on: time counts only while it does.",
        n=minutes,
    )


class MemoryLedger:
    """A book that is forgotten with its process: for tests, and for tools that show light to no eye."""

    def __init__(self, clock: Clock, window_s: float = 86400.0, page: Page | None = None, boot: str = "this") -> None:
        self._clock, self._window_s, self._boot, self.page = clock, window_s, boot, page or Page()
        self._looked()

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """What an eye has got in the window."""
        return self._looked().spent(eye)

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose before it is given."""
        return self._looked().reserve(eyes, dose_j_per_cm2, stop_j_per_cm2, self._window_s, self._clock.wall())

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Count what was really given instead."""
        self._looked().settle(reserved, given_j_per_cm2)

    def _looked(self) -> Page:
        self.page.look(self._boot, self._clock.now_s(), self._window_s)
        return self.page
