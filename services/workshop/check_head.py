"""`diffuscope check`: consistency of the active calibration with the last captures or with new dark frames."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.calibration_validity import refuse_other_mode
from device.calibration.monitoring.finding import Finding
from device.calibration.monitoring.head_check import CaptureAssessment, ExposurePair, assess_capture, check
from device.clock import Clock
from device.config.head_file import CalibrationTable, InstrumentSpec
from device.errors import HeadMismatch
from device.head import Bench, open_bench
from device.optics.lit_angle import has_sharp_edge
from device.recon.assessment.psf_match_any_refraction import PsfMatchTest
from device.recon.estimation.refraction.estimator import RefractionEstimator, can_estimate_refraction
from device.recon.model.fft_plans import Planner
from device.values import Calibration, ExposureSettings
from services.identity.audit_key import find_audit_key
from services.instrument.calibration_monitor import (
    CHECKED_CAPTURES,
    captures_with_calibration,
    exposures,
    in_force_since,
    reported_refractions,
)
from services.records import schema
from services.records.capture import Capture
from services.records.capture_store import CaptureStore
from services.records.earlier_stores import refuse_earlier_store

DARKS = 3


@dataclass(frozen=True)
class CheckResult:
    """Result of `diffuscope check`: calibration and findings.

    `captures`: number of stored captures with this calibration; `darks`: number of dark frames, taken without captures.
    """

    kept: StoredCalibration
    findings: tuple[Finding, ...]
    captures: int
    darks: int


def check_calibration(spec: InstrumentSpec, data: Path, clock: Clock, progress: Callable[[str], None]) -> CheckResult:
    """Load the active calibration and check it against the last captures in `data`, or against new dark frames.

    Raises CalibrationMissing, CalibrationDamaged, CalibrationModeMismatch, HeadMismatch, and the errors of the camera.
    """
    assert spec.calibration is not None
    kept = Archive(spec.calibration.archive).load()
    refuse_other_mode(kept.calibration, kept.provenance, spec.camera)
    captures = _load_captures(spec, kept.calibration.id, data)
    if captures:
        progress(f"looking at {min(len(captures), CHECKED_CAPTURES)} captures of {data}")
        sights = _sights_of_captures(spec, kept, captures, data)
    else:
        progress("no captures with this calibration yet: taking dark frames now")
        sights = _sights_of_darks(spec, kept, clock)
    known = kept.calibration, kept.provenance
    findings = check(*known, sights, reported_refractions(captures), clock.wall())
    return CheckResult(kept, findings, len(captures), 0 if captures else len(sights))


def with_archive(spec: InstrumentSpec, archive: Path | None) -> InstrumentSpec:
    """Return the head with its calibration archive replaced by `archive`; unchanged for None."""
    return spec if archive is None else spec.model_copy(update={"calibration": CalibrationTable(archive=archive)})


def table(found: CheckResult) -> str:
    """Return one line per finding (value, unit, limit) and its remedy, if any; a note if the PSF was not checked."""
    lines = []
    for finding in found.findings:
        mark = "ok  " if finding.ok else "note" if finding.hint else "FAIL"
        lines.append(f"{mark}  {finding.name:<12} {finding.value:>10.4g} {finding.unit:<6} limit {finding.limit:.4g}")
        if finding.remedy:
            lines.append(f"{'':<6}{finding.remedy}")
    names = {finding.name for finding in found.findings}
    if "psf" not in names:
        lines.append("      psf: no capture here tells whether it fits. Take a picture of an eye, then check again.")
    return "\n".join(lines)


def _load_captures(spec: InstrumentSpec, calibration_id: str, data: Path) -> list[Capture]:
    refuse_earlier_store(data / schema.DATABASE)
    if not (data / schema.DATABASE).is_file():
        return []
    with CaptureStore(data, key=find_audit_key(data)) as store:
        return list(captures_with_calibration(store, calibration_id, in_force_since(spec)))


def _sights_of_captures(
    spec: InstrumentSpec, kept: StoredCalibration, taken: list[Capture], data: Path
) -> list[CaptureAssessment]:
    psf_check = _psf_check(spec, kept.calibration)
    with CaptureStore(data, key=find_audit_key(data)) as store:
        found = [exposures(store, capture) for capture in taken[-CHECKED_CAPTURES:]]
    return [assess_capture(kept.calibration, kept.provenance, psf_check, exposure) for exposure in found]


def _psf_check(spec: InstrumentSpec, calibration: Calibration) -> PsfMatchTest | None:
    if not can_estimate_refraction(calibration):
        return None
    planner = Planner(None, effort="FFTW_ESTIMATE")
    return PsfMatchTest(RefractionEstimator(calibration, calibration.psfs[0].shape, planner, 0), has_sharp_edge(spec))


def _sights_of_darks(spec: InstrumentSpec, kept: StoredCalibration, clock: Clock) -> list[CaptureAssessment]:
    exposure_s = spec.camera.exposure_s
    sights = []
    with closing(open_bench(spec, clock)) as bench:
        _refuse_another_head(bench, kept)
        bench.camera.prepare(ExposureSettings(exposure_s))
        for _ in range(DARKS):
            dark = bench.camera.expose(ExposureSettings(exposure_s)).counts
            exposures = ExposurePair(clock.wall(), np.empty((0, 0), np.uint16), dark, exposure_s)
            sights.append(assess_capture(kept.calibration, kept.provenance, None, exposures))
    return sights


def _refuse_another_head(bench: Bench, kept: StoredCalibration) -> None:
    known = bench.chips.memory.read() if bench.chips.memory is not None else None
    if known is not None and known.calibration_id != kept.calibration.id:
        raise HeadMismatch(f"head {known.serial} was calibrated as {known.calibration_id[:16]}")
