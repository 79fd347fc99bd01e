"""Trial lenses before the trainer eye: offset of the refraction, check of its slope and of the cylinder's axis.

Every reading is a refraction before a stored offset is subtracted; its nominal value is that of lens and eye together
at the pupil (`device/optics/trial_lens.py`). The line M = offset + slope * nominal is fitted by weighted least squares;
J0 and J45 have the offset of the readings with spherical lenses, against which the cylinder is judged. The offset is
stored and subtracted from every refraction; slope and axis are judged only, because no lens of a trial case is known
better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, degrees, hypot, isfinite, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from device.calibration.monitoring.finding import Finding
from device.errors import CalibrationRefused
from device.optics.trial_lens import EMMETROPIC, PowerVector, TrialLens, correction_behind
from device.values import RefractionOffset

TRIAL_LENSES = (
    TrialLens(0.0),
    TrialLens(2.0),
    TrialLens(-2.0),
    TrialLens(5.0),
    TrialLens(-5.0),
    TrialLens(0.0, -2.0, 30.0),
)
LENS_SD_DPT = 0.06  # tolerance of a trial lens up to 6 dpt, ISO 9801 [unchecked]
VERTEX_SD_MM = 1.0  # of a distance taken with a ruler: 0.025 dpt at 5 dpt
MIN_SPHERES = 3  # different ones: two fix the line, and one judges it
MAX_OFFSET_DPT = 0.5  # three times 0.16 dpt, a point source 0.1 mm out of the focus of a 25 mm lens
MAX_CYLINDER_OFFSET_DPT = 0.25  # of J0 or J45: repeatability of an autorefractor, ISO 10342
MAX_SLOPE_ERROR = 0.05  # 0.25 dpt at 5 dpt, the same repeatability
MAX_RESIDUAL_DPT, MAX_RESIDUAL_SDS = 0.25, 3.0
MAX_CYLINDER_ERROR_DPT = 0.25
MAX_AXIS_ERROR_DEG = 5.0  # of a cylinder of 2 dpt: 0.35 dpt of wrong cylinder
MAX_OFFSET_SD_DPT, MAX_SLOPE_SD = 0.12, 0.025  # a quarter, and half of their limits: else nothing is judged
WORDS = {
    "offset": "the refraction is off by {value:+.2f} dpt",
    "offset_j0": "J0 is off by {value:+.2f} dpt",
    "offset_j45": "J45 is off by {value:+.2f} dpt",
    "offset_sd": "the offset is known to {value:.2f} dpt only",
    "slope": "the refraction changes by {value:+.1%} more than the lenses",
    "slope_sd": "the slope is known to {value:.1%} only",
    "line": "one reading is {value:+.2f} dpt beside the line of all",
    "cylinder": "the cylinder reads {value:+.2f} dpt more than it has",
    "axis": "the cylinder's axis reads {value:+.1f} degrees more than it has",
}

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LensReading:
    """Refraction measured with a trial lens before the eye, without offset, and its standard deviations, dpt."""

    lens: TrialLens
    found: PowerVector
    sds: PowerVector


@dataclass(frozen=True)
class TrialLensFit:
    """Result: offset, slope of M over the lenses (ideal: 1), axis and cylinder minus nominal, and the findings.

    `nominals` and `residuals_dpt` (M minus the line) are in the order of the readings.
    """

    offset: RefractionOffset
    slope: float
    slope_sd: float
    cylinder_error_dpt: float
    axis_error_deg: float
    axis_sd_deg: float
    nominals: tuple[PowerVector, ...]
    residuals_dpt: tuple[float, ...]
    findings: tuple[Finding, ...]

    @property
    def figures(self) -> tuple[tuple[str, float], ...]:
        """Figures for the provenance of the calibration that takes the offset."""
        return (
            ("trial_slope", self.slope),
            ("trial_slope_sd", self.slope_sd),
            ("trial_cylinder_error_dpt", self.cylinder_error_dpt),
            ("trial_axis_error_deg", self.axis_error_deg),
        )


class _Line(NamedTuple):
    """Line M = offset + slope * nominal, with standard deviations, residuals and the sds of the readings, dpt."""

    offset_dpt: float
    offset_sd_dpt: float
    slope: float
    slope_sd: float
    residuals_dpt: Floats
    sds_dpt: Floats


def fit_trial_lenses(readings: Sequence[LensReading], vertex_mm: float, eye: PowerVector = EMMETROPIC) -> TrialLensFit:
    """Fit the readings of trial lenses `vertex_mm` before an eye that needs the correction `eye`; judge the head.

    CalibrationRefused for readings that determine nothing: fewer than three different spheres, not exactly one
    cylinder, or values that are no numbers. Limits are judged by `refuse_beyond_limits`, so that a table can be shown.
    """
    _refuse_unusable(readings)
    nominals = tuple(correction_behind(reading.lens, vertex_mm, eye) for reading in readings)
    line = _fit_line(readings, nominals)
    spherical = [pair for pair in zip(readings, nominals, strict=True) if not pair[0].lens.cylinder_dpt]
    (j0_dpt, j0_sd), (j45_dpt, j45_sd) = (_mean_offset(spherical, component) for component in (1, 2))
    offset = RefractionOffset(line.offset_dpt, j0_dpt, j45_dpt, line.offset_sd_dpt, j0_sd, j45_sd)
    (cylinder,) = (pair for pair in zip(readings, nominals, strict=True) if pair[0].lens.cylinder_dpt)
    fit = TrialLensFit(
        offset,
        line.slope,
        line.slope_sd,
        *_cylinder_errors(*cylinder, offset, eye),
        nominals,
        tuple(line.residuals_dpt.tolist()),
        (),
    )
    return _judged(fit, line, readings)


def refuse_beyond_limits(fit: TrialLensFit) -> None:
    """Raise CalibrationRefused with the first finding that fails and its remedy; the calibration stays as it is."""
    for finding in fit.findings:
        if finding.fails:
            words = WORDS[finding.name].format(value=finding.value)
            shown = f"{finding.limit:.1%}" if finding.unit == "share" else f"{finding.limit:.2f} {finding.unit}"
            raise CalibrationRefused(f"trial lenses: {words} (at most {shown})", finding.remedy)


def _refuse_unusable(readings: Sequence[LensReading]) -> None:
    spheres = {reading.lens.sphere_dpt for reading in readings if not reading.lens.cylinder_dpt}
    cylinders = sum(1 for reading in readings if reading.lens.cylinder_dpt)
    if len(spheres) < MIN_SPHERES or cylinders != 1:
        raise CalibrationRefused(
            f"{len(spheres)} spheres and {cylinders} cylinders were read, instead of {MIN_SPHERES} or more and 1",
            "Show every lens that is asked for, once.",
        )
    for reading in readings:
        if not all(map(isfinite, (*reading.found, *reading.sds))) or min(reading.sds) <= 0:
            raise CalibrationRefused(
                f"with {reading.lens.label} the refraction is no number with a standard deviation: "
                f"{tuple(reading.found)}",
                "Show this lens again.",
            )


def _fit_line(readings: Sequence[LensReading], nominals: Sequence[PowerVector]) -> _Line:
    """Return the line of M; its sds grow with the scatter of the readings if that is larger than their own sds."""
    x, y = (
        np.array([value.m_dpt for value in values]) for values in (nominals, [reading.found for reading in readings])
    )
    lens_sds = np.array([LENS_SD_DPT if any(reading.lens) else 0.0 for reading in readings])
    sds = np.sqrt([reading.sds.m_dpt**2 for reading in readings] + lens_sds**2 + (VERTEX_SD_MM / 1000 * x**2) ** 2)
    terms = np.stack([np.ones_like(x), x], axis=1) / sds[:, None]
    covariance = np.linalg.inv(terms.T @ terms)
    offset_dpt, slope = covariance @ (terms.T @ (y / sds))
    residuals = y - offset_dpt - slope * x
    scatter = float(((residuals / sds) ** 2).sum()) / max(len(readings) - 2, 1)
    offset_sd, slope_sd = np.sqrt(np.diag(covariance) * max(scatter, 1.0))
    return _Line(float(offset_dpt), float(offset_sd), float(slope), float(slope_sd), residuals, sds)


def _mean_offset(pairs: Sequence[tuple[LensReading, PowerVector]], component: int) -> tuple[float, float]:
    """Return the weighted mean of measured minus nominal of one component, and its sd, dpt."""
    off = np.array([reading.found[component] - nominal[component] for reading, nominal in pairs])
    weights = np.array([reading.sds[component] ** -2 for reading, _ in pairs])
    mean = float((weights * off).sum() / weights.sum())
    scatter = float((weights * (off - mean) ** 2).sum()) / max(len(pairs) - 1, 1)
    return mean, sqrt(max(scatter, 1.0) / float(weights.sum()))


def _cylinder_errors(
    reading: LensReading, nominal: PowerVector, offset: RefractionOffset, eye: PowerVector
) -> tuple[float, float, float]:
    """Return cylinder (dpt) and axis (degrees) of the reading minus nominal, and the sd of the axis.

    Compared is what the lens adds to the offset and to the eye's own cylinder.
    """
    seen = np.array(
        [reading.found.j0_dpt - offset.j0_dpt - eye.j0_dpt, reading.found.j45_dpt - offset.j45_dpt - eye.j45_dpt]
    )
    due = np.array([nominal.j0_dpt - eye.j0_dpt, nominal.j45_dpt - eye.j45_dpt])
    turned_deg = degrees(atan2(seen[1], seen[0]) - atan2(due[1], due[0])) / 2
    sd_dpt = hypot(max(reading.sds[1:]), max(offset.j0_sd_dpt, offset.j45_sd_dpt))
    return 2 * (hypot(*seen) - hypot(*due)), (turned_deg + 90) % 180 - 90, degrees(sd_dpt / hypot(*due)) / 2


def _judged(fit: TrialLensFit, line: _Line, readings: Sequence[LensReading]) -> TrialLensFit:
    """Return the fit with its findings: precision first, because a limit is judged only by what is known."""
    worst = int(np.argmax(np.abs(fit.residuals_dpt) / line.sds_dpt))
    lens = readings[worst].lens.label
    off = fit.offset
    again = "More light, or a trainer eye with more vessels, then show the lenses again."
    focus = (
        "Set the trainer eye to 0 dpt, or give the correction that it alone needs. If that is right, the calibration's "
        "point source was out of focus: calibrate the head again."
    )
    oblique = "Put eye and lenses upright and on the axis; then the calibration's point source: calibrate again."
    slope = "The scale per dioptre of the head is wrong: calibrate it with `calibrate --dioptres`."
    distance = f"It is that of {lens}: measure its distance from the pupil, and show it again."
    turned = (
        "Turn the cylinder to the axis that is asked for, handle as the examiner sees it. If it is, the picture is "
        "turned or mirrored: look at `upright` in the head file."
    )
    residual_limit = max(MAX_RESIDUAL_DPT, MAX_RESIDUAL_SDS * float(line.sds_dpt[worst]))
    rows = (
        ("offset_sd", max(off.m_sd_dpt, off.j0_sd_dpt, off.j45_sd_dpt), MAX_OFFSET_SD_DPT, "dpt", again),
        ("slope_sd", fit.slope_sd, MAX_SLOPE_SD, "share", again),
        ("line", fit.residuals_dpt[worst], residual_limit, "dpt", distance),
        ("slope", fit.slope - 1, MAX_SLOPE_ERROR, "share", slope),
        ("offset", off.m_dpt, MAX_OFFSET_DPT, "dpt", focus),
        ("offset_j0", off.j0_dpt, MAX_CYLINDER_OFFSET_DPT, "dpt", oblique),
        ("offset_j45", off.j45_dpt, MAX_CYLINDER_OFFSET_DPT, "dpt", oblique),
        ("axis", fit.axis_error_deg, MAX_AXIS_ERROR_DEG, "deg", turned),
        ("cylinder", fit.cylinder_error_dpt, MAX_CYLINDER_ERROR_DPT, "dpt", "Look at the lens, and show it again."),
    )
    findings = tuple(
        Finding(name, abs(value) <= limit, value, limit, unit, "" if abs(value) <= limit else remedy)
        for name, value, limit, unit, remedy in rows
    )
    return replace(fit, findings=findings)
