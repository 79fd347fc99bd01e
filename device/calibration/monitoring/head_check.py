"""Calibration checks from ordinary captures: does the active calibration still fit this head.

    assess_capture     turns one capture, a lit frame and its dark frame, into a CaptureAssessment
    check              turns the recent captures into findings
    raise_on_failure   raises the error of a failed finding, with which a new capture is refused

Only a frame that shows an eye through its whole pupil is compared with the PSF: a small or decentred pupil cuts the
beam, and scores like another diffuser. One capture may show a blink or a moving eye; so two of the last three must
agree before pictures are refused. The sources of the limits are in device/calibration/decisions/.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from math import hypot
from statistics import median

import numpy as np

from device.calibration.archive import Provenance
from device.calibration.calibration_validity import check_age
from device.calibration.monitoring.dark_frame import DarkFrameAssessment, assess_dark_frame
from device.calibration.monitoring.finding import Finding
from device.calibration.procedure.refraction_zero import (
    CHANGE,
    LIKENESS,
    MAX_ZERO_DPT,
    MIN_SAME_PATTERN,
    PATTERN_REMEDY,
    ZERO_REMEDY,
)
from device.errors import CalibrationExpired, CalibrationStale
from device.recon.assessment.psf_match_any_refraction import PsfMatchResult, PsfMatchTest
from device.values import Calibration, Counts

RECENT_CAPTURES = 3  # number of recent captures that decide
MIN_FAILED_CAPTURES = 2  # number of them that must fail before pictures are refused

MAX_SCORE_SD = 0.15  # a frame with a larger score sd is too dark or empty, and is not used for the PSF
MIN_SCORE = 0.6
MAX_SHIFT_DEG = 0.5
MAX_WIDTH_CHANGE = 0.009
HOT_HINT_SHARE = 1e-4  # share of pixels; unmarked, they cost 0.05 and 0.35 of correlation (NUMERICS.md 6.1)
MAX_HOT = 1e-3
BLACK_DN = 1.5  # in addition to one doubling of the dark current
MAX_NOISE_RATIO = 1.5  # ratio to the calibration

SITTING_GAP = timedelta(minutes=10)
MIN_SITTINGS = 8
MIN_EDGE_SITTINGS = 5
EDGE_SLACK_DEG = 0.4  # textbook frames of a sensor overfilled by a soft field are up to 0.35 off in the median
POPULATION_SD_DPT, SLACK_DPT = 2.5, 1.0  # sd of the mean sphere in a population, and tolerance of the relay

CALIBRATE_REMEDY = CalibrationStale.default_remedy
REPEAT_REMEDY = "Take another picture. If that says so too, none is taken any more until the head is calibrated."


@dataclass(frozen=True)
class CaptureAssessment:
    """Assessment of one capture; `statement` is its PSF match, None if not tested or if the lit frame shows no eye."""

    taken_at: datetime
    dark: DarkFrameAssessment
    statement: PsfMatchResult | None


@dataclass(frozen=True)
class ExposurePair:
    """Lit frame and dark frame, counts (rows, cols), with their date and time and their exposure, s.

    `shows_eye`: the lit frame shows a retina through the whole pupil, so that it is evidence about the head.
    """

    taken_at: datetime
    lit: Counts
    dark: Counts
    exposure_s: float
    shows_eye: bool = True


@dataclass(frozen=True)
class ReportedRefraction:
    """Reported refraction of one capture: mean sphere in dpt (positive: myopia), and diameter of the lit field.

    `field_deg` and its sd are in degrees, as found with the refraction; the sd is 0 for a field that was not estimated.
    """

    taken_at: datetime
    m_dpt: float
    field_deg: float
    field_deg_sd: float


def assess_capture(
    calibration: Calibration,
    provenance: Provenance | None,
    witness: PsfMatchTest | None,
    exposures: ExposurePair,
    between: Callable[[], None] = lambda: None,
) -> CaptureAssessment:
    """Return the assessment of one capture; `witness` is the PSF match test (None: the PSF is not tested).

    `between` is called every few milliseconds and may abort the assessment by raising an exception.
    """
    seen = assess_dark_frame(calibration, provenance, exposures.dark, exposures.exposure_s, between)
    between()
    if witness is None or not exposures.shows_eye:
        return CaptureAssessment(exposures.taken_at, seen, None)
    return CaptureAssessment(exposures.taken_at, seen, witness(exposures.lit, exposures.dark, between))


def check(
    calibration: Calibration,
    provenance: Provenance | None,
    assessments: Sequence[CaptureAssessment],
    refractions: Sequence[ReportedRefraction],
    now: datetime,
) -> tuple[Finding, ...]:
    """Return the findings on age, zero, PSF, field, refraction and darks for which the data suffice, in any order."""
    recent = sorted(assessments, key=lambda assessment: assessment.taken_at)
    statements = [
        assessment.statement
        for assessment in recent
        if assessment.statement is not None and assessment.statement.sd <= MAX_SCORE_SD
    ]
    fitting = [statement for statement in statements if statement.upper_limit >= MIN_SCORE][-RECENT_CAPTURES:]
    found = [check_age(provenance, now)] if provenance is not None else []
    if provenance is not None:
        found += _zero_findings(calibration, dict(provenance.figures))
    if statements:
        found.append(_psf_finding(statements[-RECENT_CAPTURES:]))
    if fitting:
        found += _field_findings(fitting)
    sittings = _sittings(refractions)
    if len(sittings) >= MIN_SITTINGS:
        found.append(_scale_finding([median(refraction.m_dpt for refraction in sitting) for sitting in sittings]))
    measured = [refraction for refraction in refractions if refraction.field_deg_sd > 0]
    sharp_deg = None if calibration.soft_edge_deg else calibration.field_deg  # shading of a retina moves a soft edge
    if sharp_deg is not None and len(eyes := _sittings(measured)) >= MIN_EDGE_SITTINGS:
        found.append(_edge_finding(sharp_deg, eyes))
    if recent:
        found += _dark_findings(calibration, [assessment.dark for assessment in recent[-RECENT_CAPTURES:]])
    return tuple(found)


def raise_on_failure(findings: Sequence[Finding]) -> None:
    """Raise CalibrationExpired (age) or CalibrationStale (all others) for the first finding that fails, if any."""
    for finding in findings:
        if not finding.fails:
            continue
        message = f"{finding.name}: {finding.value:.3g} {finding.unit}".rstrip() + f" (limit {finding.limit:.3g})"
        if finding.name == "age":
            raise CalibrationExpired(f"the calibration is too old, {message}")
        raise CalibrationStale(f"the calibration no longer fits this head, {message}")


def _psf_finding(statements: Sequence[PsfMatchResult]) -> Finding:
    """Return the PSF finding of the last captures: failed if two do not match, a hint if only the newest does not."""
    doubts = sum(statement.upper_limit < MIN_SCORE for statement in statements)
    value = median(statement.upper_limit for statement in statements)
    if doubts >= MIN_FAILED_CAPTURES:
        return Finding("psf", False, value, MIN_SCORE, "of 1", CALIBRATE_REMEDY)
    if statements[-1].upper_limit < MIN_SCORE:
        return Finding("psf", False, statements[-1].upper_limit, MIN_SCORE, "of 1", REPEAT_REMEDY, hint=True)
    return Finding("psf", True, value, MIN_SCORE, "of 1")


def _field_findings(statements: Sequence[PsfMatchResult]) -> list[Finding]:
    """Return the findings on shift (degrees) and size (%) of the lit field: lamp, diffuser or sensor may have moved.

    None for a field without a sharp edge.
    """
    offsets_deg = [statement.field_offset_deg for statement in statements if statement.field_offset_deg is not None]
    changes = [
        statement.field_radius_change_ratio
        for statement in statements
        if statement.field_radius_change_ratio is not None
    ]
    if not offsets_deg or not changes:
        return []
    down, right = (median(offset[axis] for offset in offsets_deg) for axis in (0, 1))
    wider = median(changes)
    return [
        _hint(
            "shift",
            hypot(down, right),
            MAX_SHIFT_DEG,
            "deg",
            "The field is off its place: see whether the lamp, the "
            "diffuser or the sensor sits loose, or whether eyes are held off the axis.",
        ),
        _hint(
            "width",
            100 * abs(wider),
            100 * MAX_WIDTH_CHANGE,
            "%",
            "The field has another size: the distance from the "
            "diffuser to the sensor may have changed. Dioptres and micrometres are wrong by that share.",
        ),
    ]


def _zero_findings(calibration: Calibration, figures: Mapping[str, float]) -> list[Finding]:
    """Return the findings on scale (dpt) and pattern (%) of the PSF against the head's calibration before it.

    None without such a calibration, and no scale once trial lenses fix the zero.
    """
    found = []
    if CHANGE in figures and calibration.refraction_offset is None:
        found.append(_hint("zero", abs(figures[CHANGE]), MAX_ZERO_DPT, "dpt", ZERO_REMEDY))
    if LIKENESS in figures:
        unlike = 100 * (1 - figures[LIKENESS])
        found.append(_hint("pattern", unlike, 100 * (1 - MIN_SAME_PATTERN), "%", PATTERN_REMEDY))
    return found


def _scale_finding(persons: Sequence[float]) -> Finding:
    """Return the finding on the median refraction of many patients: near zero, unless the relay has moved."""
    limit_dpt = SLACK_DPT + 3 * 1.25 * POPULATION_SD_DPT / len(persons) ** 0.5  # 1.25: a median's spread over a mean's
    return _hint(
        "scale",
        abs(median(persons)),
        limit_dpt,
        "dpt",
        "Most eyes seem to have the same refraction: the relay may have moved. Look at a model eye.",
    )


def _edge_finding(calibrated_deg: float, sittings: Sequence[Sequence[ReportedRefraction]]) -> Finding:
    """Return the finding on the diameter of the lit field, the median over many patients, against the calibrated one.

    The sd of the median comes from the reported ones.
    """
    found_deg = [median(refraction.field_deg for refraction in sitting) for sitting in sittings]
    variance_deg2 = float(
        np.mean([median(refraction.field_deg_sd for refraction in sitting) ** 2 for sitting in sittings])
    )
    limit_deg = EDGE_SLACK_DEG + 2 * 1.25 * (variance_deg2 / len(sittings)) ** 0.5
    return _hint(
        "edge",
        abs(median(found_deg) - calibrated_deg),
        limit_deg,
        "deg",
        "The lit field has another diameter than the calibration in several eyes: see whether the stop or the lamp was "
        "changed or moved, and calibrate the head.",
    )


def _sittings(refractions: Sequence[ReportedRefraction]) -> list[list[ReportedRefraction]]:
    """Return the refractions of each sitting: captures at most 10 minutes apart count as one patient."""
    sittings: list[list[ReportedRefraction]] = []
    for refraction in sorted(refractions, key=lambda refraction: refraction.taken_at):
        if not sittings or refraction.taken_at - sittings[-1][-1].taken_at > SITTING_GAP:
            sittings.append([])
        sittings[-1].append(refraction)
    return sittings


def _dark_findings(calibration: Calibration, darks: Sequence[DarkFrameAssessment]) -> list[Finding]:
    """Return the findings on hot pixels, black level and, where the calibration has it, noise of the dark frames."""
    pixels = calibration.psfs[0].pixels.size
    seen = np.unique(np.concatenate([dark.hot for dark in darks]), return_counts=True)[1]
    hot = float((seen >= min(MIN_FAILED_CAPTURES, len(darks))).sum()) / pixels
    off_dn = abs(median(dark.black_off_dn for dark in darks))
    warmth_dn = median(dark.dark_current_dn for dark in darks)
    found = [
        _hot_pixel_finding(hot),
        _hint(
            "black level",
            off_dn,
            BLACK_DN + warmth_dn,
            "DN",
            "The dark is not as dark as it was. Every picture "
            "has a dark frame of its own, so it stays true; but shade the head, let it cool, and look again.",
        ),
    ]
    noises = [dark.noise_ratio for dark in darks if dark.noise_ratio is not None]
    if noises:
        remedy = "The sensor is noisier than it was: shade the head, let it cool, and look again."
        found.append(_hint("dark noise", median(noises), MAX_NOISE_RATIO, "times", remedy))
    return found


def _hot_pixel_finding(share: float) -> Finding:
    """Return the finding on the share of hot pixels: a failure above MAX_HOT, a hint above HOT_HINT_SHARE."""
    if share > MAX_HOT:
        return Finding("hot pixels", False, 100 * share, 100 * MAX_HOT, "%", CALIBRATE_REMEDY)
    return _hint(
        "hot pixels", 100 * share, 100 * HOT_HINT_SHARE, "%", "More pixels shine in the dark. Plan a calibration."
    )


def _hint(name: str, value: float, limit: float, unit: str, remedy: str) -> Finding:
    """Return a finding that is ok up to the limit and a hint beyond it."""
    beyond = value > limit
    return Finding(name, not beyond, value, limit, unit, remedy if beyond else "", hint=beyond)
