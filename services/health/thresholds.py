"""Thresholds of health checks and alerts, and one comparison for each rule: a value at its limit is permitted.

Limits of a head (temperature, battery) are in its head file, their comparisons in device/config/operating_limits.py;
the age of a calibration is judged in device/calibration/calibration_validity.py.
"""

import math
from datetime import UTC, datetime, timedelta

from device.config.operating_limits import is_too_hot

MIN_VISITS_LEFT = 10  # visits of a morning, both eyes each
MAX_SHOWN_VISITS = 200  # larger numbers are not shown, on the page neither: they change with every picture
MAX_LATENESS_S = 1.0  # margin beyond the time budget: above it the instrument is too slow
MAX_OVERRUN = 0.05  # share of the time budget: above it a picture has missed its deadline
MAX_COMPUTER_C = 80.0  # a Raspberry Pi reduces its clock above this
WARM_MARGIN_C = 5.0  # margin below the limit of the head at which it counts as warm
COOLING_S = 300.0  # the text of the alert says five minutes
VISITS_PER_CHARGE = 60  # visits per charge: an estimate, three hours at three minutes each; no battery is chosen yet
MAX_UNSAVED_DAYS = 7.0  # age of the first capture that is in no backup: a week of pictures may be lost with the device
MAX_AUDIT_LOG_MB = 50.0  # about 170,000 entries: each backup holds the whole log
EARLIEST_DATE = datetime(2026, 1, 1, tzinfo=UTC)  # before the first instrument
MAX_CLOCK_DRIFT_S = 3600.0  # difference of date and monotonic time; no clock drifts so far in a day


def are_few_visits(visits: int) -> bool:
    """Return whether fewer than MIN_VISITS_LEFT visits are left, of disk space or of battery charge."""
    return visits < MIN_VISITS_LEFT


def are_many_visits(visits: int) -> bool:
    """Return whether a number of visits is too large to be shown: more than MAX_SHOWN_VISITS."""
    return visits > MAX_SHOWN_VISITS


def is_late(lateness_s: float) -> bool:
    """Return whether a capture exceeds its time budget by more than MAX_LATENESS_S."""
    return lateness_s > MAX_LATENESS_S


def misses_deadline(took_s: float, budget_s: float) -> bool:
    """Return whether a picture was made later than its time budget by more than MAX_OVERRUN of it."""
    return took_s > (1 + MAX_OVERRUN) * budget_s


def is_warm(head_c: float, limit_c: float) -> bool:
    """Return whether the head is more than `limit_c` - WARM_MARGIN_C warm; true also above the limit."""
    return is_too_hot(head_c, limit_c - WARM_MARGIN_C)


def visits_per_battery(charge_ratio: float, least_ratio: float) -> int:
    """Return the estimated number of visits until the charge (0 to 1) falls to the least one; negative below it."""
    return math.floor((charge_ratio - least_ratio) * VISITS_PER_CHARGE + 1e-9)  # 10 visits are not 9.999


def is_backup_due(now: datetime, unsaved_since: datetime | None) -> bool:
    """Return whether the first capture since the last backup began, if there is one, is older than MAX_UNSAVED_DAYS."""
    return unsaved_since is not None and now - unsaved_since > timedelta(days=MAX_UNSAVED_DAYS)


def earliest_date(newest: datetime | None) -> datetime:
    """Return the earliest plausible date: EARLIEST_DATE, or the time of the newest capture if that is later."""
    return max(EARLIEST_DATE, newest or EARLIEST_DATE)


def is_date_wrong(now: datetime, newest: datetime | None) -> bool:
    """Return whether a date is before `earliest_date(newest)`; both with a time zone."""
    return now < earliest_date(newest)


def has_clock_jumped(drift_s: float) -> bool:
    """Return whether date and monotonic time differ by more than MAX_CLOCK_DRIFT_S since the start of the process."""
    return abs(drift_s) > MAX_CLOCK_DRIFT_S
