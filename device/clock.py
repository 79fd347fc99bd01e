"""Clocks, real and virtual, deadlines on them, and the id of the boot; all other modules take the time from here."""

import time
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol
from uuid import uuid4

from device.errors import SettingError

_BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")


class Clock(Protocol):
    """Source of monotonic and wall-clock time."""

    def now_s(self) -> float:
        """Return monotonic seconds since a fixed moment."""

    def wall(self) -> datetime:
        """Return date and time of day, with a time zone."""

    def sleep(self, duration_s: float) -> None:
        """Sleep for `duration_s` seconds."""


class SystemClock:
    """Clock of the computer."""

    def now_s(self) -> float:
        """Return monotonic seconds since a fixed moment."""
        return time.monotonic()  # as cameras stamp their frames

    def wall(self) -> datetime:
        """Return date and time of day in UTC."""
        return datetime.now(UTC)

    def sleep(self, duration_s: float) -> None:
        """Sleep for `duration_s` seconds; return at once for a negative duration."""
        time.sleep(max(0.0, duration_s))


def set_system_clock(moment: datetime) -> None:
    """Set the clock of the computer to a time with a time zone; PermissionError without the capability."""
    time.clock_settime(time.CLOCK_REALTIME, moment.timestamp())


def boot_id() -> str:
    """Return the kernel's id of the current boot; monotonic times are comparable within one boot only.

    If the kernel has none, a random id at each call, as if each call were in another boot.
    """
    return _BOOT_ID_FILE.read_text(encoding="ascii").strip() if _BOOT_ID_FILE.is_file() else uuid4().hex


@dataclass
class VirtualClock:
    """Simulated clock for tests: `sleep` advances it at once, without waiting."""

    start: datetime = datetime(2026, 1, 1, tzinfo=UTC)
    elapsed_s: float = field(default=0.0)

    def now_s(self) -> float:
        """Return virtual seconds since the clock was made."""
        return self.elapsed_s

    def wall(self) -> datetime:
        """Return the virtual date and time: `start` plus the elapsed seconds."""
        return self.start + timedelta(seconds=self.elapsed_s)

    def sleep(self, duration_s: float) -> None:
        """Advance the clock by `duration_s` seconds; a negative duration does not change it."""
        self.elapsed_s += max(0.0, duration_s)


@dataclass(frozen=True)
class Deadline:
    """Deadline on a given clock."""

    clock: Clock
    due_s: float

    @classmethod
    def after(cls, clock: Clock, budget_s: float) -> "Deadline":
        """Return the deadline `budget_s` seconds from now; SettingError unless the budget is positive and finite."""
        if not 0 < budget_s < float("inf"):
            raise SettingError(f"a budget of {budget_s} s is not a time", "Give a positive number of seconds.")
        return cls(clock, clock.now_s() + budget_s)

    def left_s(self) -> float:
        """Return the seconds until the deadline; negative after it."""
        return self.due_s - self.clock.now_s()

    def fits(self, cost_s: float) -> bool:
        """Return true if a step of `cost_s` seconds that begins now would end by the deadline."""
        return cost_s <= self.left_s()

    def later(self, delay_s: float) -> "Deadline":
        """Return a new deadline, later by `delay_s` seconds, to compensate for time that another task used."""
        return Deadline(self.clock, self.due_s + delay_s)
