"""Health checks: whether the instrument can take a picture now, each with its value, limit and remedy.

A check is a function from `StatusSnapshot` to `Check`, listed in `CHECKS`. services/health/collector.py collects the
snapshot in the process of the instrument, which alone owns the head; the checks have no side effects.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from device.config.operating_limits import is_battery_low, is_too_hot
from device.errors import DiffuscopeError, StoreError
from services.errors import NO_FILES_REMEDY
from services.health import thresholds
from services.health.thresholds import (
    MAX_AUDIT_LOG_MB,
    MAX_COMPUTER_C,
    MAX_LATENESS_S,
    MAX_SHOWN_VISITS,
    MAX_UNSAVED_DAYS,
    MIN_VISITS_LEFT,
)
from services.records.capture import ClockState
from services.records.recovery_report import RecoveryReport


@dataclass(frozen=True)
class Check:
    """Result of one health check: measured value, limit, and remedy as texts.

    `of_release`: the release of the software may be the cause of a failure, so an update must pass this check.
    `known`: False if the check is ok only because there were no data.
    """

    name: str
    ok: bool
    value: str
    limit: str
    remedy: str
    of_release: bool = False
    known: bool = True


@dataclass(frozen=True)
class PressTimes:
    """Seconds from the last read-out and from the tap of a press to its picture, and its time budget."""

    from_read_out_s: float
    from_tap_s: float
    budget_s: float


@dataclass(frozen=True)
class Percentiles:
    """50th and 99th percentile of a time, seconds."""

    p50_s: float
    p99_s: float


@dataclass(frozen=True)
class PictureTimes:
    """Times of the last pictures: their number, that of missed deadlines, and percentiles; `late`: over the budget."""

    pictures: int
    missed: int
    from_read_out: Percentiles
    from_tap: Percentiles
    late: Percentiles


@dataclass(frozen=True)
class StatusSnapshot:
    """Inputs of the health checks at one moment; None where the instrument has no such part.

    `problem`, `calibration`, `store`: error of that part or None; `captures_left`, `people_left`: captures and visits
    that fit on the disk; `battery`: charge, 0 to 1, or the error of its reading; `emptiest`: lowest charge; `newest`:
    time of the last capture; `presses`: times of the last captures; `torn_bytes`: size of each quarantined capture;
    `orphans`: number of complete capture folders without a row; `damaged`: number of captures and visits whose row
    cannot be read; `unsent`: numbers of visits in the upload queue and of those that need help from a user (None:
    upload is not set up); `recovery`: what the last start restored; `backup_at`: time at which the last backup began;
    `unsaved_since`: time of the first capture after that; `unchecked_limits`: names of the light limits that were not
    compared with the purchased standard; `takes_blue_light`: whether the programme lists blue among its colours;
    `settings_problem`: message and remedy of settings of the card that were not taken at the last start;
    `audit_log_bytes`: size of the audit log; `throttled_bits`: state of supply and clock as the firmware of a Raspberry
    Pi reports it; `lacks_files`: whether free files, not free bytes, limit `captures_left`.
    """

    state: str
    problem: DiffuscopeError | None
    lamp_is_dark: bool
    calibration: DiffuscopeError | None
    store: StoreError | None
    captures_left: int
    people_left: int
    battery: DiffuscopeError | float | None
    emptiest: float
    head_c: DiffuscopeError | float | None
    warmest_c: float
    computer_c: float | None
    now: datetime
    clock: ClockState
    newest: datetime | None
    presses: Sequence[PressTimes]
    torn_bytes: Sequence[int] = ()
    orphans: int = 0
    damaged: int = 0
    unsent: tuple[int, int] | None = None
    recovery: RecoveryReport = field(default_factory=RecoveryReport)
    backup_at: datetime | None = None
    unsaved_since: datetime | None = None
    unchecked_limits: tuple[str, ...] = ()
    takes_blue_light: bool = False
    settings_problem: tuple[str, str] | None = None
    throttled_bits: int | None = None
    lacks_files: bool = False
    audit_log_bytes: int = 0


def camera(facts: StatusSnapshot) -> Check:
    """Check that no problem prevents captures and that the instrument has started; fails during a calibration too."""
    value, remedy = "open", ""
    if facts.problem is not None:
        value = facts.problem.message
        remedy = facts.problem.remedy
    elif facts.state == "starting":
        value, remedy = "getting ready", "The instrument is getting ready. Wait a minute."
    return Check("camera", not remedy, value, "open, and nothing wrong", remedy, of_release=True)


def lamp(facts: StatusSnapshot) -> Check:
    """Check that the lamp was dark at least once within twice the longest permitted light (`max_on_s`)."""
    value = "dark" if facts.lamp_is_dark else "does not go out"
    return Check("lamp", facts.lamp_is_dark, value, "dark when not in use", LAMP_REMEDY, of_release=True)


LAMP_REMEDY = "Keep every eye away from the device. Turn it off, and call the technician."


def calibration(facts: StatusSnapshot) -> Check:
    """Check that no calibration error forbids captures (missing, of another head or sensor mode, expired, stale)."""
    return _result(facts.calibration, "calibration", "fits", "fits this head", of_release=True)


def captures(facts: StatusSnapshot) -> Check:
    """Check that the store accepts a file and returns the newest capture, and has no orphans and no damaged rows.

    Orphan: complete capture folder without a row.
    """
    limit = "can be written and read"
    if facts.store is not None:
        return _result(facts.store, "captures", "", limit, of_release=True)
    problems = []
    remedies = []
    if facts.orphans:
        many = _count(facts.orphans, "capture is", "captures are")
        problems.append(f"{many} on the disk without an entry in the database")
        remedies.append(ORPHANS_REMEDY)
    if facts.damaged:
        many = _count(facts.damaged, "entry", "entries")
        problems.append(f"{many} of the database cannot be read")
        remedies.append(DAMAGED_REMEDY)
    return Check("captures", not problems, "; ".join(problems) or "safe", limit, " ".join(remedies), of_release=True)


def database(facts: StatusSnapshot) -> Check:
    """Check that the last start needed no rebuilding of the database and found no two states of a record."""
    problems = []
    if facts.recovery.rebuilt_because is not None:
        problems.append(f"rebuilt from the files of the store at the last start: {facts.recovery.rebuilt_because}")
    if facts.recovery.conflicts:
        problems.append(f"{_count(len(facts.recovery.conflicts), 'record has', 'records have')} a second state")
    if facts.recovery.missing:
        problems.append(f"{_count(len(facts.recovery.missing), 'chosen picture is', 'chosen pictures are')} gone")
    if facts.recovery.lost_visits:
        problems.append(f"{_count(len(facts.recovery.lost_visits), 'visit is', 'visits are')} gone")
    remedy = DATABASE_REMEDY if problems else ""
    return Check("database", not problems, "; ".join(problems) or "whole", "whole at the last start", remedy)


DATABASE_REMEDY = "What is listed is the newest state; what it replaced is saved. If this comes back, replace the card."
ORPHANS_REMEDY = (
    "Pictures without an entry are not listed. They stay on the disk: remove nothing, copy the folder of the captures "
    "to another disk, and call the technician."
)
DAMAGED_REMEDY = "What has such an entry is not listed. Its pictures stay on the disk. Call the technician."


def _count(number: int, singular: str, plural: str) -> str:
    return f"{number} {singular if number == 1 else plural}"


def space(facts: StatusSnapshot) -> Check:
    """Check that the disk has space for MIN_VISITS_LEFT visits.

    Free bytes and free files (inodes) count. Quarantined captures count as free space; their number and size are in the
    value.
    """
    left = facts.people_left
    torn = facts.torn_bytes
    value = f"plenty, more than {MAX_SHOWN_VISITS} patients" if thresholds.are_many_visits(left) else f"{left} patients"
    if torn:
        value += f"; half-saved pictures aside: {len(torn)}, {math.ceil(sum(torn) / 1e6)} MB"
    ok = not thresholds.are_few_visits(left)
    remedy = "Copy captures away and make room."
    if not ok and facts.lacks_files:
        value, remedy = f"{value}; the disk takes few more files", NO_FILES_REMEDY
    return Check("space", ok, value, f"at least {MIN_VISITS_LEFT}", remedy)


def battery(facts: StatusSnapshot) -> Check:
    """Check that the charge of the battery is at least `emptiest`; ok but not known without a gauge."""
    limit = f"at least {facts.emptiest:.0%}"
    if facts.battery is None:
        return Check("battery", True, "no gauge", limit, "", known=False)
    if isinstance(facts.battery, DiffuscopeError):
        return _result(facts.battery, "battery", "", limit)
    return Check(
        "battery",
        not is_battery_low(facts.battery, facts.emptiest),
        f"{facts.battery:.0%}",
        limit,
        "Charge the device before the next patient.",
    )


def heat(facts: StatusSnapshot) -> Check:
    """Check that head and computer are at most at their temperature limits; ok but not known without a reading."""
    limit = f"head {facts.warmest_c:.0f} C, computer {MAX_COMPUTER_C:.0f} C"
    if isinstance(facts.head_c, DiffuscopeError):
        return _result(facts.head_c, "heat", "", limit)
    temperatures = [(facts.head_c, facts.warmest_c, "head"), (facts.computer_c, MAX_COMPUTER_C, "computer")]
    readings = ", ".join(f"{name} {is_c:.0f} C" for is_c, _, name in temperatures if is_c is not None)
    ok = all(is_c is None or not is_too_hot(is_c, most_c) for is_c, most_c, _ in temperatures)
    if not readings:
        return Check("heat", True, "not measured", limit, "", known=False)
    return Check("heat", ok, readings, limit, "Turn the device off, and let it cool in the shade.")


def clock(facts: StatusSnapshot) -> Check:
    """Check that the date is not before EARLIEST_DATE or the newest capture: pictures carry this date.

    Ok but not known if nothing has set the clock since the start of the computer.
    """
    earliest = thresholds.earliest_date(facts.newest)
    how = CLOCK_WORDS[facts.clock]
    value = f"{facts.now:%Y-%m-%d %H:%M} UTC, {how}"
    limit = f"not before {earliest:%Y-%m-%d %H:%M}"
    ok = not thresholds.is_date_wrong(facts.now, facts.newest)
    remedy = "Set date and time before the next picture."
    return Check("clock", ok, value, limit, remedy, known=facts.clock != "not_set" or not ok)


CLOCK_WORDS: dict[ClockState, str] = {
    "network": "set by the network",
    "rtc": "kept by the clock of the board",
    "browser": "set by a tablet, not verified",
    "not_set": "time not set",
}


def speed(facts: StatusSnapshot) -> Check:
    """Check that the 99th percentile of the time over the budget of the last 100 captures is at most MAX_LATENESS_S.

    Ok but not known without captures.
    """
    limit = f"99 of 100 at most {MAX_LATENESS_S:g} s over their budget"
    times = picture_times(facts.presses)
    if times is None:
        return Check("speed", True, "no pictures yet", limit, "", known=False)
    read_out, tap = times.from_read_out, times.from_tap
    value = (
        f"of {times.pictures} pictures half within {read_out.p50_s:.2f} s of the last frame and {tap.p50_s:.2f} s of "
        f"the tap, 99 of 100 within {read_out.p99_s:.2f} s and {tap.p99_s:.2f} s; {times.missed} missed their deadline"
    )
    remedy = "Turn the device off and on, and let it cool. If it stays slow, call the technician."
    return Check("speed", not thresholds.is_late(times.late.p99_s), value, limit, remedy)


def picture_times(presses: Sequence[PressTimes]) -> PictureTimes | None:
    """Return the times of pictures and how many missed their deadline; None without pictures."""
    if not presses:
        return None
    missed = sum(thresholds.misses_deadline(press.from_read_out_s, press.budget_s) for press in presses)
    return PictureTimes(
        len(presses),
        missed,
        _percentiles([press.from_read_out_s for press in presses]),
        _percentiles([press.from_tap_s for press in presses]),
        _percentiles([press.from_read_out_s - press.budget_s for press in presses]),
    )


def _percentiles(seconds: Sequence[float]) -> Percentiles:
    ordered_s = sorted(seconds)
    p50_s, p99_s = (ordered_s[math.ceil(share * len(ordered_s)) - 1] for share in (0.5, 0.99))
    return Percentiles(p50_s, p99_s)


def sending(facts: StatusSnapshot) -> Check:
    """Check that no visit in the upload queue is stuck; ok but not known if upload is not set up."""
    limit = "no visit needs help to be sent"
    if facts.unsent is None:
        return Check("sending", True, "not set up", limit, "", known=False)
    waiting, stuck = facts.unsent
    remedy = "Open Send on the page: it says why. Nothing is lost."
    return Check("sending", stuck == 0, f"{waiting} wait, {stuck} of them need help", limit, remedy)


def backup(facts: StatusSnapshot) -> Check:
    """Check that no capture of more than a week ago is in no backup."""
    value = "none yet" if facts.backup_at is None else f"last on {facts.backup_at:%Y-%m-%d}"
    is_due = thresholds.is_backup_due(facts.now, facts.unsaved_since)
    limit = f"every picture within {MAX_UNSAVED_DAYS:.0f} days"
    return Check("backup", not is_due, value, limit, BACKUP_REMEDY if is_due else "")


BACKUP_REMEDY = "Put in a USB stick and open Backup on the technician's page: what is only on this device can be lost."


def audit_log(facts: StatusSnapshot) -> Check:
    """Check that the audit log is at most MAX_AUDIT_LOG_MB large: it only grows, and each backup holds it."""
    size_mb = facts.audit_log_bytes / 1e6
    limit = f"at most {MAX_AUDIT_LOG_MB:.0f} MB"
    return Check("audit_log", size_mb <= MAX_AUDIT_LOG_MB, f"{size_mb:.0f} MB", limit, AUDIT_LOG_REMEDY)


AUDIT_LOG_REMEDY = "A technician stops the instrument and moves the entries to a drive: diffuscope audit archive FILE."


BLUE_LIGHT = (
    "; the programme takes blue light, which has 45 times the hazard of green at the same drive"  # OPTICS.md 4.4
)


def light_limits(facts: StatusSnapshot) -> Check:
    """Check that the light limits were compared with the purchased standard; ok but not known if not.

    At most half of a limit that was not compared is used (`MAX_UNCHECKED_SHARE` in device/light_safety/hazard.py).
    """
    limit = "each compared with the standard"
    blue = BLUE_LIGHT if facts.takes_blue_light else ""
    if not facts.unchecked_limits:
        return Check("light_limits", True, "compared with the standard" + blue, limit, "")
    many = _count(len(facts.unchecked_limits), "number", "numbers")
    value = f"{many} not compared with the purchased standard, so at most half of a limit is used"
    return Check("light_limits", True, value + blue, limit, "", known=False)


def settings(facts: StatusSnapshot) -> Check:
    """Check that the last start took the file `diffuscope.toml` of the card, if it has one."""
    message, remedy = facts.settings_problem or ("taken", "")
    return Check("settings", facts.settings_problem is None, message, "taken at the last start", remedy)


def power(facts: StatusSnapshot) -> Check:
    """Check that the supply of the board was never too low since its start, and that its clock is not reduced now.

    Ok but not known on another computer. Bits: `vcgencmd get_throttled` of Raspberry Pi's documentation.
    """
    limit = "5 V since the start, full clock"
    if facts.throttled_bits is None:
        return Check("power", True, "not measured", limit, "", known=False)
    found = [(words, remedy) for bit, words, remedy in THROTTLED if facts.throttled_bits >> bit & 1]
    value = ", ".join(words for words, _ in found) or "steady"
    return Check("power", not found, value, limit, " ".join(dict.fromkeys(remedy for _, remedy in found)))


SUPPLY_REMEDY = "Use the supply of the parts list (5 V, 5 A) with its own cable, and charge the battery."
COOLING_REMEDY = "Let the device cool, and check that its fan turns."
THROTTLED = (
    (0, "supply too low now", SUPPLY_REMEDY),
    (16, "supply too low since the start", SUPPLY_REMEDY),
    (2, "clock reduced", COOLING_REMEDY),
    (3, "close to the highest temperature", COOLING_REMEDY),
)


def _result(error: DiffuscopeError | None, name: str, value: str, limit: str, of_release: bool = False) -> Check:
    if error is None:
        return Check(name, True, value, limit, "", of_release)
    return Check(name, False, error.message, limit, error.remedy, of_release)


CHECKS: tuple[Callable[[StatusSnapshot], Check], ...] = (
    camera,
    lamp,
    calibration,
    captures,
    database,
    space,
    battery,
    heat,
    clock,
    speed,
    sending,
    backup,
    audit_log,
    light_limits,
    settings,
    power,
)


def run_checks(facts: StatusSnapshot) -> list[Check]:
    """Return the result of every check, in the order of CHECKS."""
    return [check(facts) for check in CHECKS]
