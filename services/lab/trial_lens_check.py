"""`diffuscope trial-lenses`: offset and check of the refraction with lenses before a trainer eye.

    calibrate_with_lenses   shows each lens, measures its refraction, judges the head, and stores the offset
    keep_offset             judges readings and stores their offset
    table                   the readings and findings as text

The offset becomes part of a new calibration, which differs from the one in force in nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from device.calibration.archive import Archive, Provenance, StoredCalibration
from device.calibration.calibration_validity import refuse_simulated_change
from device.calibration.trial_lenses import (
    TRIAL_LENSES,
    LensReading,
    TrialLensFit,
    fit_trial_lenses,
    refuse_beyond_limits,
)
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import CalibrationRefused, SpecError
from device.head import Head, open_head
from device.light_safety.burst import require_lit
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.trial_lens import EMMETROPIC, PowerVector, TrialLens
from device.recon.estimation.refraction import NoRefraction, RefractionEstimator
from device.recon.estimation.refraction_notation import report_of
from device.recon.model.fft_plans import Planner
from device.values import ExposureSettings, HeadIdentity, Illumination

VERTEX_MM = 12.0  # of a trial frame, from the lens to the pupil
REMEDY = "Put the trainer eye's pupil on the axis, 37.5 mm before the first lens, and its field into the light."


@dataclass(frozen=True)
class LensBench:
    """Distance of the lenses from the pupil in mm, correction that the trainer eye alone needs in dpt, and lenses."""

    vertex_mm: float = VERTEX_MM
    eye: PowerVector = EMMETROPIC
    lenses: tuple[TrialLens, ...] = TRIAL_LENSES


@dataclass(frozen=True)
class TrialLensResult:
    """Readings with their fit; `stored` is the calibration with the offset, now in force."""

    readings: tuple[LensReading, ...]
    fit: TrialLensFit
    stored: StoredCalibration


def calibrate_with_lenses(
    spec: InstrumentSpec, bench: LensBench, clock: Clock, ask: Callable[[str], None], progress: Callable[[str], None]
) -> TrialLensResult:
    """Measure the refraction with each trial lens and put the calibration with the offset in force.

    The lamp shines on a trainer eye, never on a person. `ask` prompts the operator of a real head and returns once the
    lens is there. CalibrationRefused if the head is outside its limits, after `progress` has the table; the calibration
    in force then stays. SpecError for a head file without an archive; errors of the head's parts and its archive.
    """
    if spec.calibration is None:
        raise SpecError(f"{spec.name} names no archive of calibrations", "Give one with --archive.")
    archive = Archive(spec.calibration.archive)
    head = open_head(spec, clock, MemoryLedger(clock))
    try:
        head.check()
        stored = archive.load(head.calibration.id)
        refuse_simulated_change(stored.calibration, is_simulated=head.kind == "simulated")
        readings = _readings(head, bench, ask, progress)
        done = keep_offset(archive, stored, readings, bench, progress)
        if head.chips.memory is not None:
            head.chips.memory.write(HeadIdentity(done.stored.provenance.serial, done.stored.calibration.id))
        return done
    finally:
        head.close()


def keep_offset(
    archive: Archive,
    stored: StoredCalibration,
    readings: tuple[LensReading, ...],
    bench: LensBench,
    progress: Callable[[str], None],
) -> TrialLensResult:
    """Judge the readings of a head and put its calibration with their offset in force; errors as above."""
    fit = fit_trial_lenses(readings, bench.vertex_mm, bench.eye)
    for line in table(readings, fit):
        progress(line)
    refuse_beyond_limits(fit)
    calibration = replace(stored.calibration, refraction_offset=fit.offset)
    with_offset = StoredCalibration(calibration, _with_figures(stored.provenance, fit))
    archive.add_and_activate(calibration, with_offset.provenance)
    return TrialLensResult(readings, fit, with_offset)


def table(readings: tuple[LensReading, ...], fit: TrialLensFit) -> tuple[str, ...]:
    """Return one line per lens (nominal and measured correction, M beside the line), then one per finding."""
    lines = [f"{'lens':<22} {'nominal M  J0  J45':<22} {'measured M  J0  J45':<22} {'sd of M':>8} {'off line':>8}"]
    for one, nominal, off_dpt in zip(readings, fit.nominals, fit.residuals_dpt, strict=True):
        due, seen = (" ".join(f"{value:+6.2f}" for value in values) for values in (nominal, one.found))
        lines.append(f"{one.lens.label:<22} {due:<22} {seen:<22} {one.sds.m_dpt:>8.2f} {off_dpt:>+8.2f}")
    off = fit.offset
    lines.append(
        f"offset M {off.m_dpt:+.3f} (sd {off.m_sd_dpt:.3f}), J0 {off.j0_dpt:+.3f} (sd {off.j0_sd_dpt:.3f}), "
        f"J45 {off.j45_dpt:+.3f} (sd {off.j45_sd_dpt:.3f}) dpt; slope {fit.slope:.3f} (sd {fit.slope_sd:.3f})"
    )
    for finding in fit.findings:
        mark = "ok  " if finding.ok else "FAIL"
        lines.append(f"{mark}  {finding.name:<12} {finding.value:>+10.3f} {finding.unit:<6} limit {finding.limit:.3g}")
    return tuple(lines)


def _with_figures(provenance: Provenance, fit: TrialLensFit) -> Provenance:
    """Return the provenance with the figures of the trial lenses in place of earlier ones."""
    names = {name for name, _ in fit.figures}
    kept = tuple(pair for pair in provenance.figures if pair[0] not in names)
    return replace(provenance, figures=kept + fit.figures)


def _readings(
    head: Head, bench: LensBench, ask: Callable[[str], None], progress: Callable[[str], None]
) -> tuple[LensReading, ...]:
    calibration, camera = head.calibration.for_colour(head.spec.light.colour), head.spec.camera
    estimator = RefractionEstimator(calibration, (camera.rows, camera.cols), Planner(None, effort="FFTW_ESTIMATE"), 0)
    readings = []
    for lens in bench.lenses:
        if head.place_trial_lens is not None:
            head.place_trial_lens(lens, bench.vertex_mm)
        else:
            ask(_prompt(lens, bench))
        progress(f"measuring with {lens.label}")
        readings.append(_read(head, estimator, lens))
    return tuple(readings)


def _prompt(lens: TrialLens, bench: LensBench) -> str:
    if not any(lens):
        return "Put the trainer eye before the head, without a lens."
    return f"Put the lens {lens.label} before the trainer eye, {bench.vertex_mm:g} mm before its pupil."


def _read(head: Head, estimator: RefractionEstimator, lens: TrialLens) -> LensReading:
    """Return the refraction of a dark and a lit frame; CalibrationRefused if there is none."""
    shot = ExposureSettings(head.spec.camera.exposure_s)
    head.camera.prepare(shot)
    dark = head.camera.expose(shot).counts.copy()
    with head.light.on(Illumination(head.spec.light.colour)):
        lit = require_lit(head.camera.expose(shot)).counts.copy()
    found = estimator.find(lit, dark, estimator.defects(lit, dark))
    if not isinstance(found, NoRefraction):
        found = estimator.add_cylinder(found)
    if isinstance(found, NoRefraction):
        raise CalibrationRefused(f"with {lens.label} the refraction cannot be measured: {found.reason}", REMEDY)
    report = report_of(found)
    values = [float(report[key] or 0.0) for key in ("sphere", "j0", "j45", "sd", "j0_sd", "j45_sd")]
    return LensReading(lens, PowerVector(*values[:3]), PowerVector(*values[3:]))
