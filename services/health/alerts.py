"""Alerts: conditions that the page shows, such as `store.low`, and the rules by which they are active."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Literal

from device.calibration.monitoring.finding import Finding
from device.config.operating_limits import is_battery_low, is_too_hot
from device.values import Eye
from services.health import thresholds
from services.health.thresholds import COOLING_S
from services.records.laterality_correction import LateralityQuestion
from services.records.upload_queue import QueueStatus

AlertCode = Literal[
    "store.full",
    "store.low",
    "heat.hot",
    "heat.warm",
    "batt.empty",
    "batt.low",
    "cal.old",
    "clock.unset",
    "clock.wrong",
    "make.slow",
    "eye.side",
    "send.stuck",
    "send.waiting",
]


@dataclass(frozen=True)
class Alert:
    """Active alert: its code, and those values that its text needs (the others are None).

    `n`: a number of visits or weeks; `date`: ISO 8601; `wait_s`: seconds to wait; `id`, `slot`, `other`: a capture, its
    slot and the other eye.
    """

    code: AlertCode
    n: int | None = None
    date: str | None = None
    wait_s: int | None = None
    id: str | None = None
    slot: str | None = None
    other: Eye | None = None

    def facts(self) -> dict[str, object]:
        """Return the code and the present values by name, as fields of an event."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass
class CoolingTimer:
    """Timer of the cooling periods of an overheated head, COOLING_S each; `since_s` is the start of the first."""

    since_s: float | None = None

    def wait_s(self, now_s: float) -> int:
        """Return the remaining time of the current cooling period in s; the next period follows without a gap.

        `now_s`: monotonic time; the first call starts the first period.
        """
        self.since_s = now_s if self.since_s is None else self.since_s
        return int(COOLING_S - (now_s - self.since_s) % COOLING_S)


def space_alerts(captures_left: int, visits_left: int) -> Iterator[Alert]:
    """Return the alert of the free disk space: `store.full` without space for a capture, else `store.low`."""
    if captures_left == 0:
        yield Alert("store.full")
    elif thresholds.are_few_visits(visits_left):
        yield Alert("store.low", n=visits_left)


def heat_alerts(head_c: float, limit_c: float, cooling: CoolingTimer, now_s: float) -> Iterator[Alert]:
    """Return the alert of the head's temperature: `heat.hot` above the limit, else `heat.warm`.

    `cooling` starts when the head becomes too hot and is reset when it is not; `now_s` is the monotonic time.
    """
    if is_too_hot(head_c, limit_c):
        yield Alert("heat.hot", wait_s=cooling.wait_s(now_s))
        return
    cooling.since_s = None
    if thresholds.is_warm(head_c, limit_c):
        yield Alert("heat.warm")


def battery_alerts(charge_ratio: float, least_ratio: float) -> Iterator[Alert]:
    """Return the alert of the battery: `batt.empty` below the least charge, else `batt.low` for few visits."""
    visits = thresholds.visits_per_battery(charge_ratio, least_ratio)
    if is_battery_low(charge_ratio, least_ratio):
        yield Alert("batt.empty")
    elif thresholds.are_few_visits(visits):
        yield Alert("batt.low", n=visits)


def calibration_alerts(findings: Sequence[Finding]) -> Iterator[Alert]:
    """Return the alert `cal.old` with the age in weeks, if a finding is the age warning."""
    yield from (Alert("cal.old", n=int(finding.value)) for finding in findings if is_age_warning(finding))


def is_age_warning(finding: Finding) -> bool:
    """Return whether a finding is the hint that the calibration is old but may still be used (alert `cal.old`).

    False for an expired calibration, and for one whose date is in the future.
    """
    return finding.name == "age" and finding.hint and finding.limit > 0


def date_alerts(
    now: datetime, newest: datetime | None, drift_s: float, is_synchronised: bool, needs_time: bool = False
) -> Iterator[Alert]:
    """Return the alert `clock.unset` for a clock that needs a tablet's time, or `clock.wrong` for a wrong date.

    A wrong date is impossible or has jumped.
    Impossible: `thresholds.is_date_wrong`, with the time of the newest capture. Jumped:
    `thresholds.has_clock_jumped` since the start of the process, unless the network has set the clock.
    """
    if needs_time:
        yield Alert("clock.unset")
        return
    has_jumped = thresholds.has_clock_jumped(drift_s) and not is_synchronised
    if thresholds.is_date_wrong(now, newest) or has_jumped:
        yield Alert("clock.wrong", date=now.astimezone().date().isoformat())


def lateness_alerts(late_s: float) -> Iterator[Alert]:
    """Return the alert `make.slow` if a capture in progress is late."""
    if thresholds.is_late(late_s):
        yield Alert("make.slow")


def laterality_alerts(question: LateralityQuestion | None) -> Iterator[Alert]:
    """Return the alert `eye.side` for a capture whose estimated eye differs from its recorded eye."""
    if question is not None:
        yield Alert("eye.side", id=question.id, slot=question.slot, other=question.other)


def upload_alerts(queue: QueueStatus) -> Iterator[Alert]:
    """Return the alerts of the upload queue.

    `send.stuck`: number `n` of stuck visits, `date` of the first failure; `send.waiting`: `n` others, if any fails.
    """
    if queue.stuck_since is not None:
        yield Alert("send.stuck", n=queue.stuck, date=queue.stuck_since.astimezone().date().isoformat())
    if queue.failing:
        yield Alert("send.waiting", n=queue.waiting - queue.stuck)
