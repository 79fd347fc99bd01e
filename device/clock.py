"""The only door to time: a clock that can be real or virtual, and a deadline made from it."""

import time
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Protocol

from device.errors import SettingError


class Clock(Protocol):
    """Where the time comes from."""

    def now_s(self) -> float:
        """Seconds since some fixed moment; never goes back."""

    def wall(self) -> datetime:
        """The date and time of day, with a time zone."""

    def sleep(self, duration_s: float) -> None:
        """Do nothing for `duration_s` seconds."""


class SystemClock:
    """The computer's own clock."""

    def now_s(self) -> float:
        """Seconds since some fixed moment; never goes back."""
        return time.monotonic()  # as cameras stamp their frames

    def wall(self) -> datetime:
        """The date and time of day in UTC."""
        return datetime.now(UTC)

    def sleep(self, duration_s: float) -> None:
        """Do nothing for `duration_s` seconds."""
        time.sleep(max(0.0, duration_s))


@dataclass
class VirtualClock:
    """A clock that moves only when told: sleeping takes no time, and hours pass in microseconds."""

    start: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    elapsed_s: float = field(default=0.0)

    def now_s(self) -> float:
        """Virtual seconds since the clock was made."""
        return self.elapsed_s

    def wall(self) -> datetime:
        """The virtual date and time."""
        return self.start + timedelta(seconds=self.elapsed_s)

    def sleep(self, duration_s: float) -> None:
        """Move the clock on by `duration_s`."""
        self.elapsed_s += max(0.0, duration_s)


@dataclass(frozen=True)
class Deadline:
    """A moment by which an answer is due, on a given clock."""

    clock: Clock
    due_s: float

    @classmethod
    def after(cls, clock: Clock, budget_s: float) -> "Deadline":
        """The moment `budget_s` seconds from now; a budget must be a positive, finite number of seconds."""
        if not 0 < budget_s < float("inf"):
            raise SettingError(f"a budget of {budget_s} s is not a time", "Give a positive number of seconds.")
        return cls(clock, clock.now_s() + budget_s)

    def left_s(self) -> float:
        """Seconds until it is due; negative once it has passed."""
        return self.due_s - self.clock.now_s()

    def fits(self, cost_s: float) -> bool:
        """Whether something that takes `cost_s` would be done in time."""
        return cost_s <= self.left_s()

    def later(self, delay_s: float) -> "Deadline":
        """The same, put off by `delay_s` that somebody else used."""
        return Deadline(self.clock, self.due_s + delay_s)
