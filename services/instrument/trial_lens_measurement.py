"""Measurement of a head with trial lenses before a trainer eye, up to the calibration with the offset in force.

    LensCheck     presents the lenses to a simulated head, measures a refraction with each, and fits the readings
    keep_offset   judges a fit and puts the calibration with its offset in force

The command `diffuscope trial-lenses` and the technician's page use both. The offset becomes part of a new calibration,
which differs from the one in force in nothing else.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from math import isclose

from device.calibration.archive import Archive, Provenance, StoredCalibration
from device.calibration.calibration_validity import refuse_simulated_change
from device.calibration.trial_lenses import (
    TRIAL_LENSES,
    LensReading,
    TrialLensFit,
    fit_trial_lenses,
    refuse_beyond_limits,
)
from device.config.head_file import InstrumentSpec
from device.config.shipped_heads import LIGHT_PATH
from device.errors import CalibrationRefused, DiffuscopeError, HardwareError
from device.head import Head
from device.light_safety.burst import require_lit
from device.optics.light_path import load_light_path
from device.optics.trial_lens import EMMETROPIC, PowerVector, TrialLens
from device.recon.estimation.refraction.estimator import NoRefraction, RefractionEstimator
from device.recon.estimation.refraction.notation import report_of
from device.recon.model.fft_plans import Planner
from device.values import ExposureSettings, HeadIdentity, Illumination

VERTEX_MM = 12.0  # of a trial frame, from the lens to the pupil


@dataclass(frozen=True)
class LensBench:
    """Distance of the lenses from the pupil in mm, correction that the trainer eye alone needs in dpt, and lenses."""

    vertex_mm: float = VERTEX_MM
    eye: PowerVector = EMMETROPIC
    lenses: tuple[TrialLens, ...] = TRIAL_LENSES


@dataclass(frozen=True)
class TrialLensOutcome:
    """Readings of a finished run; `stored` is the calibration with the offset, now in force.

    `fit` is None if the readings determine nothing, `stored` is None if the head was refused or nothing could be
    stored; then the calibration in force stays, and `failure` has the reason.
    """

    bench: LensBench
    readings: tuple[LensReading, ...]
    ended_at: datetime
    fit: TrialLensFit | None = None
    stored: StoredCalibration | None = None
    failure: DiffuscopeError | None = None


class LensCheck:
    """Measurement on an opened head whose calibration in force is in `archive`; the thread of the head alone uses it.

    Errors of the head's parts and of the archive; those of `refuse_simulated_change`.
    """

    def __init__(self, head: Head, archive: Archive, bench: LensBench) -> None:
        head.check()
        self._head, self._archive, self._bench = head, archive, bench
        self._stored = archive.load(head.calibration.id)
        refuse_simulated_change(self._stored.calibration, is_simulated=head.kind == "simulated")
        calibration = head.calibration.for_colour(head.spec.light.colour)
        camera = head.spec.camera
        planner = Planner(None, effort="FFTW_ESTIMATE")
        shape = (camera.rows, camera.cols)
        self._estimator = RefractionEstimator(calibration, shape, planner, 0)

    def present(self, lens: TrialLens) -> bool:
        """Put the lens before the eye of a simulated head; return False for a real one, whose operator does."""
        if self._head.place_trial_lens is None:
            return False
        self._head.place_trial_lens(lens, self._bench.vertex_mm)
        return True

    def read(self, lens: TrialLens) -> LensReading:
        """Return the refraction of a dark and a lit frame with the lens in place; CalibrationRefused if there is none.

        The lamp is dark afterwards. Errors of the camera and the guarded light.
        """
        head = self._head
        estimator = self._estimator
        shot = ExposureSettings(head.spec.camera.exposure_s)
        head.camera.prepare(shot)
        dark = head.camera.expose(shot).counts.copy()
        with head.light.on(Illumination(head.spec.light.colour)):
            lit = require_lit(head.camera.expose(shot)).counts.copy()
        found = estimator.find(lit, dark, estimator.defects(lit, dark))
        if not isinstance(found, NoRefraction):
            found = estimator.add_cylinder(found)
        if isinstance(found, NoRefraction):
            raise CalibrationRefused(
                f"with {lens.label} the refraction cannot be measured: {found.reason}", alignment_remedy(head.spec)
            )
        report = report_of(found)
        values = [float(report[key] or 0.0) for key in ("sphere", "j0", "j45", "sd", "j0_sd", "j45_sd")]
        return LensReading(lens, PowerVector(*values[:3]), PowerVector(*values[3:]))

    def fit(self, readings: Sequence[LensReading]) -> TrialLensFit:
        """Return the fit of the readings with its findings; CalibrationRefused if they determine nothing."""
        return fit_trial_lenses(readings, self._bench.vertex_mm, self._bench.eye)

    def keep(self, fit: TrialLensFit) -> StoredCalibration:
        """Put the calibration with the offset in force and write its id into the head's memory.

        After an error the calibration in force is the one before: those of `keep_offset`, BusFault of the memory.
        """
        kept = keep_offset(self._archive, self._stored, fit)
        memory = self._head.chips.memory
        if memory is None:
            return kept
        try:
            memory.write(HeadIdentity(kept.provenance.serial, kept.calibration.id))
        except HardwareError:
            self._archive.activate(self._stored.calibration.id)  # the memory still names it
            raise
        return kept


def keep_offset(archive: Archive, stored: StoredCalibration, fit: TrialLensFit) -> StoredCalibration:
    """Judge the head, and return its calibration with the offset, which is then in force.

    CalibrationRefused if the head is outside its limits; the calibration in force then stays. Errors of the archive.
    """
    refuse_beyond_limits(fit)
    calibration = replace(stored.calibration, refraction_offset=fit.offset)
    provenance = _with_figures(stored.provenance, fit)
    archive.add_and_activate(calibration, provenance)
    return StoredCalibration(calibration, provenance)


def alignment_remedy(spec: InstrumentSpec) -> str:
    """Return what to do if the refraction of the trainer eye cannot be measured on this head.

    The pupil stands in the front focus of the first lens: at its focal length in the light path that comes with the
    program, if the head has the magnification of that path; else no distance is known.
    """
    place = "where the head's lenses image it onto the iris"
    if spec.optics is not None:
        path = load_light_path(LIGHT_PATH)
        if isclose(spec.optics.angular_magnification, path.optics.angular_magnification, rel_tol=1e-6):
            place = f"{path.relay.first_mm:g} mm before the first lens"
    return f"Put the trainer eye's pupil on the axis, {place}, and its field into the light."


def _with_figures(provenance: Provenance, fit: TrialLensFit) -> Provenance:
    """Return the provenance with the figures of the trial lenses in place of earlier ones."""
    names = {name for name, _ in fit.figures}
    kept = tuple(pair for pair in provenance.figures if pair[0] not in names)
    return replace(provenance, figures=kept + fit.figures)
