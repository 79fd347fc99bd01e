"""Whether the instrument could take a picture now: a list of checks, each with its limit and what to do.

A check is one function from `Facts` to a `Check`, and a place in `CHECKS`. The instrument gathers the facts about
itself (`services/instrument/wellbeing.py`), because it alone holds the head; this file judges and touches nothing.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from device.errors import DiffuscopeError, StoreError

PEOPLE_LEFT = 10  # a morning in a village, both eyes of each
PLENTY = 200  # the page says no number above it either: it changes with every picture, and nobody plans by it
LATE_S = 1.0  # beside its budget a picture needs an exposure and the writing
HOTTEST_C = 80.0  # a Raspberry Pi slows down from here
EARLIEST = datetime(2026, 1, 1, tzinfo=UTC)  # nobody had this instrument before


@dataclass(frozen=True)
class Check:
    """One line of the list; `of_release` says that another version could be the cause, so an update is judged by it.

    Not `known`: the check is ok, but there were no data to judge by.
    """

    name: str
    ok: bool
    value: str
    limit: str
    remedy: str
    of_release: bool = False
    known: bool = True


@dataclass(frozen=True)
class Facts:
    """What an instrument knows of itself at one moment; None where it has no such part.

    `battery` is a share; `newest` when the last capture was; `presses` how long the last presses took, and by how much
    each was later than it was allowed to be; `torn_bytes` the size of each incomplete capture; `orphans` the number of
    capture folders without a row; `damaged` the number of captures and visits whose row cannot be read; `unsent` the
    number of visits that wait to be sent, and how many of them need manual help (None: sending is not set up).
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
    clock_was_set: bool
    newest: datetime | None
    presses: Sequence[tuple[float, float]]
    torn_bytes: Sequence[int] = ()
    orphans: int = 0
    damaged: int = 0
    unsent: tuple[int, int] | None = None


def camera(facts: Facts) -> Check:
    """The head is open, plans are made, and nothing has gone wrong since the last frame."""
    value, remedy = "open", ""
    if facts.problem is not None:
        value, remedy = facts.problem.message, facts.problem.remedy
    elif facts.state == "starting":
        value, remedy = "getting ready", "The instrument is getting ready. Wait a minute."
    return Check("camera", not remedy, value, "open, and nothing wrong", remedy, of_release=True)


def lamp(facts: Facts) -> Check:
    """The lamp is dark at least once within 2 `max_on_s`."""
    value = "dark" if facts.lamp_is_dark else "does not go out"
    return Check("lamp", facts.lamp_is_dark, value, "dark when nobody looks", STAY_AWAY, of_release=True)


STAY_AWAY = "Keep every eye away from the device. Turn it off, and call the technician."


def calibration(facts: Facts) -> Check:
    """It belongs to this head and to this mode of its sensor."""
    return _unless(facts.calibration, "calibration", "fits", "fits this head", of_release=True)


def captures(facts: Facts) -> Check:
    """The store accepts a file and returns the newest capture; no capture folder without a row, no damaged row."""
    limit = "can be written and read"
    if facts.store is not None:
        return _unless(facts.store, "captures", "", limit, of_release=True)
    said, remedies = [], []
    if facts.orphans:
        many = _number(facts.orphans, "capture is", "captures are")
        said.append(f"{many} on the disk without an entry in the database")
        remedies.append(ORPHANED)
    if facts.damaged:
        many = _number(facts.damaged, "entry", "entries")
        said.append(f"{many} of the database cannot be read")
        remedies.append(DAMAGED)
    return Check("captures", not said, "; ".join(said) or "safe", limit, " ".join(remedies), of_release=True)


ORPHANED = (
    "Pictures without an entry are not listed. They stay on the disk: remove nothing, copy the folder of the captures "
    "to another disk, and call the technician."
)
DAMAGED = "What has such an entry is not listed. Its pictures stay on the disk. Call the technician."


def _number(number: int, one: str, more: str) -> str:
    return f"{number} {one if number == 1 else more}"


def space(facts: Facts) -> Check:
    """Room for the people of a morning; what is half-kept gives its room up, so it is told and counted as free."""
    people, torn = facts.people_left, facts.torn_bytes
    value = f"{people} people" if people <= PLENTY else f"plenty, more than {PLENTY} people"
    if torn:
        value += f"; half-kept pictures aside: {len(torn)}, {math.ceil(sum(torn) / 1e6)} MB"
    ok = people >= PEOPLE_LEFT
    return Check("space", ok, value, f"at least {PEOPLE_LEFT}", "Copy captures away and make room.")


def battery(facts: Facts) -> Check:
    """Enough for the next pictures."""
    limit = f"more than {facts.emptiest:.0%}"
    if facts.battery is None:
        return Check("battery", True, "no gauge", limit, "", known=False)
    if isinstance(facts.battery, DiffuscopeError):
        return _unless(facts.battery, "battery", "", limit)
    return Check(
        "battery",
        facts.battery > facts.emptiest,
        f"{facts.battery:.0%}",
        limit,
        "Charge the device before the next patient.",
    )


def heat(facts: Facts) -> Check:
    """Neither the head nor the computer is too warm."""
    limit = f"head {facts.warmest_c:.0f} C, computer {HOTTEST_C:.0f} C"
    if isinstance(facts.head_c, DiffuscopeError):
        return _unless(facts.head_c, "heat", "", limit)
    warm = [(facts.head_c, facts.warmest_c, "head"), (facts.computer_c, HOTTEST_C, "computer")]
    said = ", ".join(f"{name} {is_c:.0f} C" for is_c, _, name in warm if is_c is not None)
    ok = all(is_c is None or is_c <= most_c for is_c, most_c, _ in warm)
    if not said:
        return Check("heat", True, "not measured", limit, "", known=False)
    return Check("heat", ok, said, limit, "Turn the device off, and let it cool in the shade.")


def clock(facts: Facts) -> Check:
    """Not before the newest capture, nor before there was such an instrument: dates on pictures depend on it."""
    earliest = max(EARLIEST, facts.newest or EARLIEST)
    how = "set by the network" if facts.clock_was_set else "never compared with another clock"
    value, limit = f"{facts.now:%Y-%m-%d %H:%M} UTC, {how}", f"not before {earliest:%Y-%m-%d %H:%M}"
    ok, remedy = facts.now >= earliest, "Set date and time before the next picture."
    return Check("clock", ok, value, limit, remedy, known=facts.clock_was_set or not ok)


def speed(facts: Facts) -> Check:
    """The 99th percentile of the lateness of the last hundred presses, over their time budget, is at most LATE_S."""
    limit = f"99 of 100 at most {LATE_S:g} s over their budget"
    if not facts.presses:
        return Check("speed", True, "no pictures yet", limit, "", known=False)
    took_s, late_s = (sorted(column) for column in zip(*facts.presses, strict=True))
    p50_s, p99_s, p99_late_s = _of(took_s, 0.5), _of(took_s, 0.99), _of(late_s, 0.99)
    value = f"half of {len(took_s)} pictures within {p50_s:.1f} s, 99 of 100 within {p99_s:.1f} s"
    if p99_late_s > 0:
        value += f", {p99_late_s:.1f} s over"
    remedy = "Turn the device off and on, and let it cool. If it stays slow, call the technician."
    return Check("speed", p99_late_s <= LATE_S, value, limit, remedy)


def _of(ordered_s: Sequence[float], share: float) -> float:
    return ordered_s[math.ceil(share * len(ordered_s)) - 1]


def sending(facts: Facts) -> Check:
    """No finished visit needs manual help to reach the receiver."""
    limit = "nobody needs help to be sent"
    if facts.unsent is None:
        return Check("sending", True, "not set up", limit, "", known=False)
    waiting, stuck = facts.unsent
    remedy = "Open Send on the page: it says why. Nothing is lost."
    return Check("sending", stuck == 0, f"{waiting} wait, {stuck} of them need help", limit, remedy)


def _unless(error: DiffuscopeError | None, name: str, value: str, limit: str, of_release: bool = False) -> Check:
    if error is None:
        return Check(name, True, value, limit, "", of_release)
    return Check(name, False, error.message, limit, error.remedy, of_release)


CHECKS: tuple[Callable[[Facts], Check], ...] = (
    camera, lamp, calibration, captures, space, battery, heat, clock, speed, sending,
)  # fmt: skip


def judged(facts: Facts) -> list[Check]:
    """Every check, in order; a check that is ok needs no remedy."""
    return [check(facts) for check in CHECKS]
