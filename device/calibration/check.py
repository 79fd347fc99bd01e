"""Does the calibration that is in force still fit this head? What ordinary captures say, each with number and limit.

    look     one capture, a lit frame and its dark one, becomes a Sight
    check    the last few of these become findings
    refuse   findings that fail become the error that a press answers with

One capture may be a blink, or an eye that moves; so two of the last three must say the same before pictures are
refused. Where the limits come from is in the README.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from math import hypot
from statistics import median

import numpy as np

from device.calibration.admission import age
from device.calibration.archive import Provenance
from device.calibration.darkness import Darkness, darkness
from device.calibration.finding import Finding
from device.errors import CalibrationOld, CalibrationStale
from device.recon.witness import Statement, Witness
from device.values import Calibration, Counts

LAST = 3  # captures that decide
AGREED = 2  # of them, before pictures are refused

SURE_SD = 0.15  # a frame with a wider score is too dark, or shows nothing: it does not say anything about the PSF
LEAST_SCORE = 0.6
OFF_DEG = 0.5
WIDER = 0.009
HOT_FROM, MOST_HOT = 1e-4, 1e-3  # share of pixels; unmarked, a picture loses 0.02 and 0.32 of likeness (optics.md 5.4)
BLACK_DN = 1.5  # and what one doubling of the warmth brings
NOISE = 1.5  # over what was measured

SAME_PERSON = timedelta(minutes=10)
LEAST_PERSONS = 8
PEOPLE_DPT, SLACK_DPT = 2.5, 1.0  # spread of mean spheres among people, and what a relay may be off

CALIBRATE = CalibrationStale.default_remedy
ONCE_MORE = "Take another picture. If that says so too, none is taken any more until the head is calibrated."


@dataclass(frozen=True)
class Sight:
    """What one capture showed; `statement` is None where the lit frame says nothing."""

    taken_at: datetime
    dark: Darkness
    statement: Statement | None


@dataclass(frozen=True)
class Exposures:
    """A lit frame and its dark one, counts (rows, cols), and when and how long they were taken."""

    taken_at: datetime
    lit: Counts
    dark: Counts
    exposure_s: float


def look(
    calibration: Calibration, known: Provenance | None, witness: Witness | None, at: Exposures,
    between: Callable[[], None] = lambda: None,
) -> Sight:  # fmt: skip
    """One capture against the calibration; `between` is called every few milliseconds, and may end it by raising."""
    seen = darkness(calibration, known, at.dark, at.exposure_s, between)
    between()
    return Sight(at.taken_at, seen, witness(at.lit, at.dark, between) if witness is not None else None)


def check(
    calibration: Calibration, known: Provenance | None, sights: Sequence[Sight],
    spheres_dpt: Sequence[tuple[datetime, float]], now: datetime,
) -> tuple[Finding, ...]:  # fmt: skip
    """Every finding that the captures allow, of `sights` and of all refractions since; the newest may come anywhere."""
    recent = sorted(sights, key=lambda one: one.taken_at)
    told = [one.statement for one in recent if one.statement is not None and one.statement.sd <= SURE_SD]
    fitting = [one for one in told if one.most >= LEAST_SCORE][-LAST:]
    found = [age(known, now)] if known is not None else []
    if told:
        found.append(_psf(told[-LAST:]))
    if fitting:
        found += _field(fitting)
    if (persons := _persons(spheres_dpt)) and len(persons) >= LEAST_PERSONS:
        found.append(_scale(persons))
    if recent:
        found += _darks(calibration, [one.dark for one in recent[-LAST:]])
    return tuple(found)


def refuse(findings: Sequence[Finding]) -> None:
    """CalibrationOld or CalibrationStale if no picture should rest on this calibration."""
    for one in findings:
        if not one.fails:
            continue
        said = f"{one.name}: {one.value:.3g} {one.unit}".rstrip() + f" (limit {one.limit:.3g})"
        if one.name == "age":
            raise CalibrationOld(f"the calibration is too old, {said}")
        raise CalibrationStale(f"the calibration no longer fits this head, {said}")


def _psf(told: Sequence[Statement]) -> Finding:
    """Whether the stored PSF is the one that light came through."""
    doubts = sum(one.most < LEAST_SCORE for one in told)
    value = median(one.most for one in told)
    if doubts >= AGREED:
        return Finding("psf", False, value, LEAST_SCORE, "of 1", CALIBRATE)
    if told[-1].most < LEAST_SCORE:
        return Finding("psf", False, told[-1].most, LEAST_SCORE, "of 1", ONCE_MORE, hint=True)
    return Finding("psf", True, value, LEAST_SCORE, "of 1")


def _field(told: Sequence[Statement]) -> list[Finding]:
    """Where the illuminated field lies, and how wide it is: lamp, diffuser or sensor have moved."""
    down, right = (median(one.off_deg[axis] for one in told) for axis in (0, 1))
    wider = median(one.wider for one in told)
    return [
        _hinted("shift", hypot(down, right), OFF_DEG, "deg", "The field is off its place: see whether the lamp, the "
                "diffuser or the sensor sits loose, or whether eyes are held off the axis."),
        _hinted("width", 100 * abs(wider), 100 * WIDER, "%", "The field has another size: the distance from the "
                "diffuser to the sensor may have changed. Dioptres and micrometres are wrong by that share."),
    ]  # fmt: skip


def _scale(persons: Sequence[float]) -> Finding:
    """What all eyes have in common: one eye's refraction looks like scale, that of many people lies around zero."""
    limit_dpt = SLACK_DPT + 3 * 1.25 * PEOPLE_DPT / len(persons) ** 0.5  # 1.25: a median's spread over a mean's
    return _hinted(
        "scale", abs(median(persons)), limit_dpt, "dpt",
        "Most eyes seem to have the same refraction: the relay may have moved. Look at a model eye.",
    )  # fmt: skip


def _persons(spheres_dpt: Sequence[tuple[datetime, float]]) -> list[float]:
    """One mean sphere per sitting: captures that follow one another belong to one person."""
    sittings: list[list[float]] = []
    last: datetime | None = None
    for taken_at, sphere_dpt in sorted(spheres_dpt):
        if last is None or taken_at - last > SAME_PERSON:
            sittings.append([])
        sittings[-1].append(sphere_dpt)
        last = taken_at
    return [median(one) for one in sittings]


def _darks(calibration: Calibration, darks: Sequence[Darkness]) -> list[Finding]:
    """Hot pixels, black level and noise of the dark frames."""
    pixels = calibration.psfs[0].pixels.size
    seen = np.unique(np.concatenate([one.hot for one in darks]), return_counts=True)[1]
    hot = float((seen >= min(AGREED, len(darks))).sum()) / pixels
    off_dn = abs(median(one.black_off_dn for one in darks))
    warmth_dn = median(one.warmth_dn for one in darks)
    found = [
        _hot(hot),
        _hinted("black level", off_dn, BLACK_DN + warmth_dn, "DN", "The dark is not as dark as it was. Every picture "
                "has a dark frame of its own, so it stays true; but shade the head, let it cool, and look again."),
    ]  # fmt: skip
    noises = [one.noisier for one in darks if one.noisier is not None]
    if noises:
        said = "The sensor is noisier than it was: shade the head, let it cool, and look again."
        found.append(_hinted("dark noise", median(noises), NOISE, "times", said))
    return found


def _hot(share: float) -> Finding:
    if share > MOST_HOT:
        return Finding("hot pixels", False, 100 * share, 100 * MOST_HOT, "%", CALIBRATE)
    return _hinted("hot pixels", 100 * share, 100 * HOT_FROM, "%", "More pixels shine in the dark. Plan a calibration.")


def _hinted(name: str, value: float, limit: float, unit: str, remedy: str) -> Finding:
    beyond = value > limit
    return Finding(name, not beyond, value, limit, unit, remedy if beyond else "", hint=beyond)
