"""Sequence of a head calibration: dark frames, flat field, point source, then optional dioptre and colour steps.

WORK/darks.npz, flats.npz, ...   checkpoints of finished steps, valid for 12 h
ARCHIVE                          written only at the end of `run`: until then the previous calibration stays active
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isnan, sqrt
from pathlib import Path
from typing import Literal

import numpy as np

from device.calibration.archive import Archive, Provenance
from device.calibration.led_radiometry import LedReadings
from device.calibration.monitoring.dark_current_model import DarkStep, dark_steps, fit_dark_current
from device.calibration.procedure.colours import SAME_PSF_CORRELATION, needs_separate_psf, refuse_moved_source
from device.calibration.procedure.darks import Darks, measure_darks
from device.calibration.procedure.dioptres import (
    DioptreScale,
    PsfSimilarity,
    fit_dioptre_scale,
    refuse_wrong_position,
    similarity_of_points,
)
from device.calibration.procedure.finished_steps import Step, StepCheckpoints
from device.calibration.procedure.flats import MIN_SHARE, Flats, measure_flats
from device.calibration.procedure.lens_check import lens_figures, lens_messages
from device.calibration.procedure.moments import Moments
from device.calibration.procedure.point_source import MotionCheck, PointSource, measure_point_source, refuse_level
from device.calibration.procedure.raw_recorder import RawRecorder
from device.calibration.procedure.refraction_zero import ZeroCheck, compare_zero, earlier_with_zero, is_in_focus
from device.calibration.procedure.step_exposures import SHORTEST_S, StepExposures
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import CalibrationError, CalibrationRefused
from device.optics.lit_angle import picture_field_deg, soft_edge_deg
from device.ports import Camera, Thermometer
from device.recon.model.spots import find_spots
from device.values import Calibration, Colour, Frame, Geometry, Psf, Sensor

CalibrationTarget = Literal[
    "cap",
    "screen",
    "point",
    "point -4 mm",
    "point -2 mm",
    "point +2 mm",
    "point +4 mm",
    "point red",
    "point green",
    "point blue",
    "point amber",
]
COLOUR_TARGETS: dict[Colour, CalibrationTarget] = {
    "red": "point red",
    "green": "point green",
    "blue": "point blue",
    "amber": "point amber",
}
AXIAL_OFFSETS_MM: dict[CalibrationTarget, float] = {
    "point -4 mm": -4.0,
    "point -2 mm": -2.0,
    "point +2 mm": 2.0,
    "point +4 mm": 4.0,
}

LONGEST_S = 10.0
FLAT_FRAMES = 16
DARK_FRAMES = 32  # dark frames: their noise is small, so averaging needs more of them
FLAT_LEVELS = (0.1, 0.2, 0.4, 0.7, 1.0, 1.15)  # relative to the exposure that fills the wells to FILLED
SATURATING_FACTOR = 2.2
TARGET_FILL_SHARE = 0.7
BRACKETS = ((1.0, 16), (4.0, 8), (16.0, 4))  # factor on the shortest exposure, and frame count
AXIAL_BRACKETS = BRACKETS[:2]  # fitting a scale does not need the tails of the PSF


@dataclass(frozen=True)
class Operator:
    """Callbacks to the operator: `place_target` returns once the target stands before the head.

    `show_message` shows one line of text. `report_figures` receives the figures of each step, measured or loaded, with
    the step's target; a pixel mask is reported as its pixel count.
    """

    place_target: Callable[[CalibrationTarget], None]
    show_message: Callable[[str], None]
    report_figures: Callable[[CalibrationTarget, dict[str, float]], None] = lambda stand, figures: None


@dataclass(frozen=True)
class CalibrationJob:
    """Parameters of one calibration of one head; `source_deg` is the angular diameter of the point source, degrees.

    Optional parts: `dioptres` moves the source along the axis behind a model-eye lens of focal length `eye_mm`;
    `source_mm` is the distance of the point source from that lens if it is stated: the zero of refractions;
    `colours` repeats the point source in these colours (the picture's colour is always measured first); `keep_raw`
    stores every raw frame; `leds` holds radiometer readings of each LED.
    """

    spec: InstrumentSpec
    serial: str
    made_by: str
    software: str
    source_deg: float = 0.0
    eye_mm: float = 25.0
    dioptres: bool = False
    colours: tuple[Colour, ...] = ()
    keep_raw: bool = False
    leds: LedReadings | None = None
    source_mm: float | None = None

    @property
    def other_colours(self) -> tuple[Colour, ...]:
        """Return the requested colours without the picture's own colour, in the order red, green, blue."""
        return tuple(colour for colour in COLOUR_TARGETS if colour in self.colours and colour != self.spec.light.colour)

    @property
    def targets(self) -> tuple[CalibrationTarget, ...]:
        """Return the calibration targets in the order in which they are needed."""
        tinted = (COLOUR_TARGETS[colour] for colour in self.other_colours)
        return ("cap", "screen", "point", *(AXIAL_OFFSETS_MM if self.dioptres else ()), *tinted)

    @property
    def geometry(self) -> Geometry | None:
        """Return the nominal geometry by the head file's table [optics]; None if it has none."""
        optics = self.spec.optics
        return optics.geometry(self.spec.camera.pitch_um) if optics else None


class CalibrationSequence:
    """Calibration of one head, step by step; after an error the archive is unchanged and finished steps are kept."""

    def __init__(
        self,
        job: CalibrationJob,
        camera: Camera,
        operator: Operator,
        clock: Clock,
        work: Path,
        thermometer: Thermometer | None = None,
    ) -> None:
        self.job, self.camera, self.operator, self.clock = job, camera, operator, clock
        self.thermometer = thermometer
        checkpoint_key = repr((job.serial, job.spec.name, job.spec.camera, job.source_deg, job.eye_mm))
        self.checkpoints = StepCheckpoints(work, checkpoint_key, clock)
        self.raw_recorder = RawRecorder(work / "raw", operator.show_message) if job.keep_raw else None
        self._exposures = StepExposures(camera, job.spec.camera, self._record_frame)

    def run(self, archive: Archive) -> str:
        """Measure each step, or load it from its checkpoint; store and activate the new calibration and return its id.

        Raises CalibrationRefused with the reason of the step, and the errors of the camera.
        """
        geometry = self._dioptre_geometry()
        in_focus = is_in_focus(self.job.source_mm, self.job.eye_mm)
        darks = self._checkpointed_step("darks", Darks, "cap", self._measure_darks)
        flats = self._checkpointed_step("flats", Flats, "screen", lambda: self._measure_flats(darks))
        point = self._checkpointed_step("point", PointSource, "point", lambda: self._measure_point(darks, flats))
        self.operator.show_message(f"point: {abs(point.off_px[0])}, {abs(point.off_px[1])} pixels off the middle")
        zero = self._check_zero(archive, point)
        dioptres = self._measure_dioptres(darks, flats, point, geometry) if geometry is not None else None
        psfs, colours = self._colour_psfs(darks, flats, point)
        calibration = self._build_calibration(darks, flats, psfs, dioptres)
        calibration = replace(calibration, source_in_focus=in_focus and (zero is None or not zero.contradicts))
        lenses = _lens_figures(self.job, archive, calibration)
        for message in lens_messages(lenses):
            self.operator.show_message(message)
        figures = (
            _measurement_figures(darks, flats, point)
            | self._dark_current_figures(archive, darks, flats)
            | _dioptre_figures(dioptres)
            | ({} if zero is None else zero.figures)
            | colours
            | lenses
        )
        id = archive.add_and_activate(calibration, self._build_provenance(figures))
        if self.raw_recorder is not None:
            self.raw_recorder.finish(archive.root / f"{id}.raw")
        self.checkpoints.clear()
        return id

    def _dioptre_geometry(self) -> Geometry | None:
        """Return the geometry for the dioptre step, None if not requested; CalibrationRefused without [optics]."""
        if self.job.dioptres and self.job.geometry is None:
            raise CalibrationRefused(
                f"the head file of {self.job.spec.name} has no table [optics], so a dioptre has no meaning",
                "Write the table [optics] into it, or leave --dioptres out.",
            )
        return self.job.geometry if self.job.dioptres else None

    def _checkpointed_step(
        self, name: str, kind: type[Step], stand: CalibrationTarget, measure: Callable[[], Step]
    ) -> Step:
        """Return a step from its valid checkpoint; else have the target `stand` placed, measure the step, save it."""
        found = self.checkpoints.load(name, kind)
        if found is not None:
            self.operator.show_message(f"{name}: measured before, taken up again")
            self.operator.report_figures(stand, step_figures(found))
            return found
        self.operator.place_target(stand)
        if self.raw_recorder is not None:
            self.raw_recorder.begin_step(name)
        measured = measure()
        self.checkpoints.save(name, measured)
        self.operator.show_message(f"{name}: done")
        self.operator.report_figures(stand, step_figures(measured))
        return measured

    def _measure_dioptres(self, darks: Darks, flats: Flats, point: PointSource, geometry: Geometry) -> DioptreScale:
        """Return the scale per dioptre, fitted to all axial positions; if the fit fails, discard their checkpoints."""
        pitch_um = self.job.spec.camera.pitch_um
        eye_mm = self.job.eye_mm
        seen: dict[float, PsfSimilarity] = {}
        for stand, moved_mm in AXIAL_OFFSETS_MM.items():

            def measure(moved_mm: float = moved_mm) -> PointSource:
                disc_px = self._disc_px() * eye_mm / (eye_mm + moved_mm)
                there = self._measure_point(darks, flats, AXIAL_BRACKETS, disc_px)
                seen[moved_mm] = similarity_of_points(point, there, pitch_um, geometry)
                refuse_wrong_position(seen[moved_mm], moved_mm, eye_mm, geometry)
                return there

            there = self._checkpointed_step(stand.replace(" ", ""), PointSource, stand, measure)
            if moved_mm not in seen:  # loaded from its checkpoint
                seen[moved_mm] = similarity_of_points(point, there, pitch_um, geometry)
        try:
            found = fit_dioptre_scale({moved_mm: seen_point.scale for moved_mm, seen_point in seen.items()}, eye_mm)
        except CalibrationRefused:
            self.checkpoints.discard(*(stand.replace(" ", "") for stand in AXIAL_OFFSETS_MM))
            raise
        factor = found.scale_per_dpt
        nominal = geometry.nominal_scale_per_dpt
        self.operator.show_message(
            f"dioptres: {factor:.3%} of stretch each, {factor / nominal - 1:+.1%} beside the drawings"
        )
        return found

    def _check_zero(self, archive: Archive, point: PointSource) -> ZeroCheck | None:
        """Return the comparison of the PSF with that of the head's last calibration whose zero is known, and show it.

        None without one, or without [optics].
        """
        job = self.job
        earlier = earlier_with_zero(archive, job.serial)
        if earlier is None or job.geometry is None:
            return None
        found = compare_zero(earlier, point.psf, job.spec.light.colour, job.geometry)
        if found is not None:
            self.operator.show_message(found.words)
        return found

    def _dark_current_figures(self, archive: Archive, darks: Darks, flats: Flats) -> dict[str, float]:
        """Return figures: sensor temperature, exposure of the map, model (if plausible); none without a thermometer."""
        if isnan(darks.warm_c):
            return {}
        now = DarkStep(darks.warm_c, darks.dark_dn_per_s * flats.gain_e_per_dn)
        found = {"dark_c": darks.warm_c, "dark_map_s": darks.map_s}
        law = fit_dark_current((*dark_steps(archive, self.job.serial), now))
        if law is None:
            return found
        message = (
            f"dark current: {now.e_per_s:.3g} e-/s at {now.temperature_c:.1f} C, "
            f"twice that every {law.doubling_c:.1f} C"
        )
        if not law.is_plausible:
            self.operator.show_message(f"{message}: this is not the sensor's warmth, and is not kept; light leaks in")
            return found
        self.operator.show_message(f"{message}, by {law.steps} dark steps")
        return found | law.figures

    def _colour_psfs(self, darks: Darks, flats: Flats, point: PointSource) -> tuple[tuple[Psf, ...], dict[str, float]]:
        """Return the PSF, one more per colour that differs, and each colour's correlation and scale to the first."""
        job = self.job
        own = dict[Colour, Psf]()
        figures = dict[str, float]()

        def similarity(there: PointSource) -> PsfSimilarity:
            return similarity_of_points(point, there, job.spec.camera.pitch_um, job.geometry)

        for colour in job.other_colours:

            def measure(colour: Colour = colour) -> PointSource:
                there = self._measure_point(darks, flats)
                refuse_moved_source(colour, similarity(there), job.geometry)
                return there

            there = self._checkpointed_step(f"point-{colour}", PointSource, COLOUR_TARGETS[colour], measure)
            found = similarity(there)
            figures |= {f"psf_{colour}_likeness": found.correlation, f"psf_{colour}_scale": found.scale}
            kept = "kept as a PSF of its own" if needs_separate_psf(found) else "the same PSF"
            self.operator.show_message(
                f"{colour}: {kept}, correlation {found.correlation:.4f} (the same from {SAME_PSF_CORRELATION})"
            )
            if needs_separate_psf(found):
                own[colour] = replace(there.psf, name=f"point source, {colour}", colour=colour)
        first = replace(point.psf, colour=job.spec.light.colour) if own else point.psf
        return (first, *own.values()), figures

    def _measure_darks(self) -> Darks:
        picture_s = self.job.spec.camera.exposure_s
        exposures = [
            self._exposures.moments(each_s, DARK_FRAMES)
            for each_s in (SHORTEST_S, picture_s, min(4 * picture_s, LONGEST_S))
        ]
        darks = measure_darks(exposures, picture_s, self.job.spec.camera.white_dn)
        return darks if self.thermometer is None else replace(darks, warm_c=self.thermometer.read_c())

    def _measure_flats(self, darks: Darks) -> Flats:
        full_s = self._exposures.exposure_for(TARGET_FILL_SHARE, darks, 50.0, 3.0, MIN_SHARE)
        levels = [self._exposures.moments(share * full_s, FLAT_FRAMES) for share in FLAT_LEVELS]
        return measure_flats(levels, self._exposures.moments(SATURATING_FACTOR * full_s, 2), darks)

    def _measure_point(
        self, darks: Darks, flats: Flats, brackets: Sequence[tuple[float, int]] = BRACKETS, disc_px: float | None = None
    ) -> PointSource:
        first_s = self._exposures.exposure_for(TARGET_FILL_SHARE, darks, 100.0, 0.6)
        first = self._exposures.moments(first_s, 1)
        refuse_level(first, darks, flats)  # without light, the centroid of the noise would move
        exposures = []
        for factor, count in brackets:
            exposure_s = min(factor * first_s, LONGEST_S)
            frames = MotionCheck(darks.at(exposure_s)).watch(self._exposures.frames(exposure_s, count))
            exposures.append(Moments.over(frames, self.camera.shape, exposure_s))
        return measure_point_source(exposures, darks, flats, self._disc_px() if disc_px is None else disc_px)

    def _record_frame(self, frame: Frame) -> None:
        """Note whether the step is simulated, and write the frame if raw frames are kept."""
        self.checkpoints.simulated |= frame.simulated
        if self.raw_recorder is not None:
            self.raw_recorder.record(frame)

    def _disc_px(self) -> float:
        geometry = self.job.geometry
        return self.job.source_deg * geometry.px_per_deg if geometry else 0.0

    def _build_calibration(
        self, darks: Darks, flats: Flats, psfs: tuple[Psf, ...], dioptres: DioptreScale | None
    ) -> Calibration:
        spec = self.job.spec
        geometry = self.job.geometry
        gain = flats.gain_e_per_dn
        if geometry is not None and dioptres is not None:
            geometry = replace(geometry, measured_scale_per_dpt=dioptres.scale_per_dpt)
        sensor = Sensor(darks.black_dn, gain, _read_noise_e(darks, gain), flats.white_dn, flats.bend_per_dn)
        return Calibration(
            psfs=psfs,
            sensor=sensor,
            geometry=geometry,
            field_deg=picture_field_deg(spec),
            soft_edge_deg=soft_edge_deg(spec),
            dark_dn=darks.map_dn,
            flat=flats.response,
            bad=darks.hot | flats.dead,
            simulated=self.checkpoints.simulated,
        )

    def _build_provenance(self, figures: dict[str, float]) -> Provenance:
        temperature_c = self.thermometer.read_c() if self.thermometer is not None else None
        job = self.job
        leds = self.job.leds
        if leds is not None:
            figures = figures | leds.figures
        identity = job.serial, self.clock.wall(), job.made_by, job.software
        return Provenance(*identity, temperature_c, tuple(figures.items()), meter=leds.measured if leds else None)


def _read_noise_e(darks: Darks, gain_e_per_dn: float) -> float:
    """Return the read noise in electrons, without the shot noise of the dark current in the shortest exposure."""
    warmth_e = darks.dark_dn_per_s * darks.shortest_s * gain_e_per_dn
    return sqrt(max((darks.read_noise_dn * gain_e_per_dn) ** 2 - max(warmth_e, 0.0), 0.0))


def step_figures(step: Darks | Flats | PointSource) -> dict[str, float]:
    """Return the float fields of a step by name, and the pixel count of each of its pixel masks."""
    found: dict[str, float] = {}
    for key, value in vars(step).items():
        if isinstance(value, float):
            found[key] = value
        elif isinstance(value, np.ndarray) and value.dtype == bool:
            found[key] = float(value.sum())
    return found


def _lens_figures(job: CalibrationJob, archive: Archive, calibration: Calibration) -> dict[str, float]:
    """Return the figures of lenslets, beside the head's calibration before if there is one; none behind a diffuser."""
    optics, geometry = job.spec.optics, calibration.geometry
    if optics is None or geometry is None or not geometry.has_spots:
        return {}
    spots = find_spots(calibration.psfs[0], geometry)
    try:
        before = archive.load()
    except CalibrationError:  # none yet, or one that cannot be read
        return lens_figures(spots, optics.element.lenses, None)
    earlier = before.calibration if before.provenance.serial == job.serial else None
    return lens_figures(spots, optics.element.lenses, earlier)


def _measurement_figures(darks: Darks, flats: Flats, point: PointSource) -> dict[str, float]:
    """Return the figures that are stored with the calibration in addition to its values."""
    return {
        "dark_e_per_s": darks.dark_dn_per_s * flats.gain_e_per_dn,
        "pattern_e": darks.pattern_dn * flats.gain_e_per_dn,
        "bad_pixels": float((darks.hot | flats.dead).sum()),
        "prnu": float(flats.response.std()),
        "nonlinearity": flats.nonlinearity,
        "screen_shading": flats.shading,
        "psf_off_rows_px": float(point.off_px[0]),
        "psf_off_cols_px": float(point.off_px[1]),
        "psf_floor": point.floor,
        "psf_pedestal_removed": point.removed,
        "psf_pedestal_residual": point.residual,
    }


def _dioptre_figures(dioptres: DioptreScale | None) -> dict[str, float]:
    """Return the figures of the dioptre step for the manifest; empty if that step did not run."""
    if dioptres is None:
        return {}
    return {
        "scale_per_dpt": dioptres.scale_per_dpt,
        "scale_per_dpt_sd": dioptres.sd_per_dpt,
        "dioptres_worst_dpt": dioptres.worst_dpt,
    }
