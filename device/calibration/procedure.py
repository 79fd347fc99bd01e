"""The order of a calibration: cap, even screen, point source, and what else the job asks the point source.

WORK/darks.npz, flats.npz, ...   steps that are done, taken up again for half a day
ARCHIVE                          changed by the last lines only: until then the old calibration stays in force
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import isnan, sqrt
from pathlib import Path
from typing import Literal

import numpy as np

from device.calibration.archive import Archive, Provenance
from device.calibration.colours import SAME, differs, refuse_other_source
from device.calibration.darks import Darks, measured_darks
from device.calibration.dioptres import Dioptres, Stretch, between, measured_dioptres, refuse_other_place
from device.calibration.flats import LEAST_SHARE, Flats, measured_flats
from device.calibration.leds import LedReadings
from device.calibration.moments import Moments
from device.calibration.point import Point, Steady, measured_point, refuse_level
from device.calibration.raws import Raws
from device.calibration.steps import Step, Steps
from device.calibration.warmth import Dark, dark_steps, fitted_warmth
from device.clock import Clock
from device.errors import CalibrationRefused
from device.ports import Camera, Thermometer
from device.spec import InstrumentSpec
from device.values import Calibration, Colour, Counts, Frame, Geometry, Psf, Sensor, Shot

Stand = Literal[
    "cap", "screen", "point", "point -4 mm", "point -2 mm", "point +2 mm", "point +4 mm",
    "point red", "point green", "point blue",
]  # fmt: skip
TINTED: dict[Colour, Stand] = {"red": "point red", "green": "point green", "blue": "point blue"}
MOVES: dict[Stand, float] = {"point -4 mm": -4.0, "point -2 mm": -2.0, "point +2 mm": 2.0, "point +4 mm": 4.0}

SHORTEST_S, LONGEST_S = 1e-3, 10.0
FRAMES = 16
MANY = 32  # darks, whose noise is small
LEVELS = (0.1, 0.2, 0.4, 0.7, 1.0, 1.15)  # of the exposure that fills the wells to FILLED
TOO_BRIGHT = 2.2
FILLED = 0.7
BRACKETS = ((1.0, 16), (4.0, 8), (16.0, 4))  # of the shortest exposure of the point, and how many frames
MOVED_BRACKETS = BRACKETS[:2]  # a scale needs no tails


@dataclass(frozen=True)
class Operator:
    """Whoever changes what stands before the head: `put` returns when it is there, `tell` says how it goes.

    `found` hears the figures of each step, measured now or before; of a map of pixels how many are marked.
    """

    put: Callable[[Stand], None]
    tell: Callable[[str], None]
    found: Callable[[Stand, dict[str, float]], None] = lambda stand, figures: None


@dataclass(frozen=True)
class Job:
    """One calibration of one head: who makes it, and through which source, `source_deg` wide as the head sees it.

    What may be left out: `dioptres` moves the source along the axis behind the model eye's lens, whose focal length is
    `eye_mm`; `colours` shows it in these colours too (the first of all is the picture's); `keep_raw` keeps every raw
    frame; `leds` is what a meter said of each LED.
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

    @property
    def others(self) -> tuple[Colour, ...]:
        """The colours beside the picture's."""
        return tuple(colour for colour in TINTED if colour in self.colours and colour != self.spec.light.colour)

    @property
    def stands(self) -> tuple[Stand, ...]:
        """What will be put before the head, in this order."""
        tinted = (TINTED[colour] for colour in self.others)
        return ("cap", "screen", "point", *(MOVES if self.dioptres else ()), *tinted)

    @property
    def geometry(self) -> Geometry | None:
        """By the drawings; None where the head file has no [optics]."""
        optics = self.spec.optics
        return optics.geometry(self.spec.camera.pitch_um) if optics else None


class Procedure:
    """Measures a head step by step. Every error leaves the steps before it kept, and the archive as it was."""

    def __init__(
        self, job: Job, camera: Camera, operator: Operator, clock: Clock, work: Path, warmth: Thermometer | None = None
    ) -> None:
        self.job, self.camera, self.operator, self.clock = job, camera, operator, clock
        self.warmth = warmth
        whose = repr((job.serial, job.spec.name, job.spec.camera, job.source_deg, job.eye_mm))
        self.steps = Steps(work, whose, clock)
        self.raws = Raws(work / "raw", operator.tell) if job.keep_raw else None
        self._counts: Counts = np.empty(camera.shape, np.uint16)

    def run(self, archive: Archive) -> str:
        """All steps that are not done yet; the new calibration is in force when this returns its id.

        Raises CalibrationRefused with the step's reason, and whatever the camera raises.
        """
        geometry = self._geometry()
        darks = self._step("darks", Darks, "cap", self._darks)
        flats = self._step("flats", Flats, "screen", lambda: self._flats(darks))
        point = self._step("point", Point, "point", lambda: self._point(darks, flats))
        self.operator.tell(f"point: {abs(point.off_px[0])}, {abs(point.off_px[1])} pixels off the middle")
        dioptres = self._dioptres(darks, flats, point, geometry) if geometry is not None else None
        psfs, colours = self._colours(darks, flats, point)
        calibration = self._assembled(darks, flats, psfs, dioptres)
        figures = _figures(darks, flats, point) | self._warmth(archive, darks, flats) | _said(dioptres) | colours
        id = archive.keep(calibration, self._provenance(figures))
        if self.raws is not None:
            self.raws.finish(archive.root / f"{id}.raw")
        self.steps.clear()
        return id

    def _geometry(self) -> Geometry | None:
        """What the dioptres are measured against; None where they are not asked for."""
        if self.job.dioptres and self.job.geometry is None:
            raise CalibrationRefused(
                f"the head file of {self.job.spec.name} has no table [optics], so a dioptre has no meaning",
                "Write the table [optics] into it, or leave --dioptres out.",
            )
        return self.job.geometry if self.job.dioptres else None

    def _step(self, name: str, kind: type[Step], stand: Stand, measure: Callable[[], Step]) -> Step:
        """What was measured before, if it is of this head and of today; else the step itself, kept at once."""
        found = self.steps.taken_up(name, kind)
        if found is not None:
            self.operator.tell(f"{name}: measured before, taken up again")
            self.operator.found(stand, numbers_of(found))
            return found
        self.operator.put(stand)
        if self.raws is not None:
            self.raws.begin(name)
        measured = measure()
        self.steps.keep(name, measured)
        self.operator.tell(f"{name}: done")
        self.operator.found(stand, numbers_of(measured))
        return measured

    def _dioptres(self, darks: Darks, flats: Flats, point: Point, geometry: Geometry) -> Dioptres:
        """The source moved along the axis, place by place; the factor of their line."""
        pitch_um, eye_mm = self.job.spec.camera.pitch_um, self.job.eye_mm
        seen: dict[float, Stretch] = {}
        for stand, moved_mm in MOVES.items():

            def measure(moved_mm: float = moved_mm) -> Point:
                disc_px = self._disc_px() * eye_mm / (eye_mm + moved_mm)
                there = self._point(darks, flats, MOVED_BRACKETS, disc_px)
                seen[moved_mm] = between(point, there, pitch_um)
                refuse_other_place(seen[moved_mm], moved_mm, eye_mm, geometry)
                return there

            there = self._step(stand.replace(" ", ""), Point, stand, measure)
            if moved_mm not in seen:  # it was measured before
                seen[moved_mm] = between(point, there, pitch_um)
        try:
            found = measured_dioptres({moved_mm: one.scale for moved_mm, one in seen.items()}, eye_mm)
        except CalibrationRefused:
            self.steps.forget(*(stand.replace(" ", "") for stand in MOVES))
            raise
        factor, nominal = found.scale_per_dpt, geometry.nominal_scale_per_dpt
        self.operator.tell(f"dioptres: {factor:.3%} of stretch each, {factor / nominal - 1:+.1%} beside the drawings")
        return found

    def _warmth(self, archive: Archive, darks: Darks, flats: Flats) -> dict[str, float]:
        """How warm it was, and the law of this dark step and the earlier ones of this head."""
        if isnan(darks.warm_c):
            return {}
        now = Dark(darks.warm_c, darks.dark_dn_per_s * flats.gain_e_per_dn)
        found = {"dark_c": darks.warm_c, "dark_map_s": darks.map_s}
        law = fitted_warmth((*dark_steps(archive, self.job.serial), now))
        if law is None:
            return found
        said = f"dark current: {now.e_per_s:.3g} e-/s at {now.warm_c:.1f} C, twice that every {law.doubling_c:.1f} C"
        if not law.is_plausible:
            self.operator.tell(f"{said}: this is not the sensor's warmth, and is not kept; light leaks in")
            return found
        self.operator.tell(f"{said}, by {law.steps} dark steps")
        return found | law.figures

    def _colours(self, darks: Darks, flats: Flats, point: Point) -> tuple[tuple[Psf, ...], dict[str, float]]:
        """The PSF, and one for each colour in which it is another; how like the first each of them is."""
        job, own, figures = self.job, dict[Colour, Psf](), dict[str, float]()
        for colour in job.others:

            def measure(colour: Colour = colour) -> Point:
                there = self._point(darks, flats)
                refuse_other_source(colour, between(point, there, job.spec.camera.pitch_um), job.geometry)
                return there

            there = self._step(f"point-{colour}", Point, TINTED[colour], measure)
            found = between(point, there, job.spec.camera.pitch_um)
            figures |= {f"psf_{colour}_likeness": found.likeness, f"psf_{colour}_scale": found.scale}
            kept = "kept as a PSF of its own" if differs(found) else "the same PSF"
            self.operator.tell(f"{colour}: {kept}, correlation {found.likeness:.4f} (the same from {SAME})")
            if differs(found):
                own[colour] = replace(there.psf, name=f"point source, {colour}", colour=colour)
        first = replace(point.psf, colour=job.spec.light.colour) if own else point.psf
        return (first, *own.values()), figures

    def _darks(self) -> Darks:
        picture_s = self.job.spec.camera.exposure_s
        exposures = [self._moments(each_s, MANY) for each_s in (SHORTEST_S, picture_s, min(4 * picture_s, LONGEST_S))]
        darks = measured_darks(exposures, picture_s, self.job.spec.camera.white_dn)
        return darks if self.warmth is None else replace(darks, warm_c=self.warmth.read_c())

    def _flats(self, darks: Darks) -> Flats:
        full_s = self._exposure_for(FILLED, darks, 50.0, 3.0, LEAST_SHARE)
        levels = [self._moments(share * full_s, FRAMES) for share in LEVELS]
        return measured_flats(levels, self._moments(TOO_BRIGHT * full_s, 2), darks)

    def _point(
        self, darks: Darks, flats: Flats, brackets: Sequence[tuple[float, int]] = BRACKETS, disc_px: float | None = None
    ) -> Point:
        first_s = self._exposure_for(FILLED, darks, 100.0, 0.6)
        refuse_level(self._moments(first_s, 1), darks, flats)  # in the dark, noise would seem to move
        exposures = []
        for factor, count in brackets:
            exposure_s = min(factor * first_s, LONGEST_S)
            frames = Steady(darks.at(exposure_s)).watch(self._frames(exposure_s, count))
            exposures.append(Moments.over(frames, self.camera.shape, exposure_s))
        return measured_point(exposures, darks, flats, self._disc_px() if disc_px is None else disc_px)

    def _disc_px(self) -> float:
        geometry = self.job.geometry
        return self.job.source_deg * geometry.px_per_deg if geometry else 0.0

    def _moments(self, exposure_s: float, count: int) -> Moments:
        return Moments.over(self._frames(exposure_s, count), self.camera.shape, exposure_s)

    def _frames(self, exposure_s: float, count: int) -> Iterator[Frame]:
        """One buffer for all of them: who wants to keep a frame keeps its mean."""
        self.camera.prepare(Shot(exposure_s))
        for _ in range(count):
            frame = self.camera.expose(Shot(exposure_s), self._counts)
            self.steps.simulated |= frame.simulated
            if self.raws is not None:
                self.raws.keep(frame)
            yield frame

    def _exposure_for(
        self, filled: float, darks: Darks, percentile: float, longest_s: float, least: float = 0.0
    ) -> float:
        """The exposure that fills that percentile of the good pixels so far; what is dim gets the longest.

        CalibrationRefused where even that fills less than `least`.
        """
        good, top_dn = ~darks.hot, self.job.spec.camera.white_dn - darks.black_dn
        exposure_s = min(self.job.spec.camera.exposure_s, longest_s)
        for _ in range(10):
            seen = self._moments(exposure_s, 1)  # which refuses a frame of another mode, or in the lamp's light
            signal_dn = float(np.percentile((seen.mean_dn - darks.at(exposure_s))[good], percentile))
            share = signal_dn / top_dn
            if 0.9 * filled < share < 1.1 * filled:
                break
            if exposure_s >= longest_s and share < least:  # now, not after minutes of long exposures
                raise CalibrationRefused(
                    f"it is dark: {signal_dn:.0f} DN in {exposure_s:.2g} s (at least {least * top_dn:.0f})",
                    "Take the cap off and switch the light on, then start again.",
                )
            factor = 1 / 8 if share > 0.95 else min(filled / max(share, 1e-6), 8.0)
            wanted_s = float(np.clip(exposure_s * factor, SHORTEST_S / 10, longest_s))
            if wanted_s == exposure_s:
                break
            exposure_s = wanted_s
        return exposure_s

    def _assembled(self, darks: Darks, flats: Flats, psfs: tuple[Psf, ...], dioptres: Dioptres | None) -> Calibration:
        spec, geometry, gain = self.job.spec, self.job.geometry, flats.gain_e_per_dn
        if geometry is not None and dioptres is not None:
            geometry = replace(geometry, measured_scale_per_dpt=dioptres.scale_per_dpt)
        sensor = Sensor(darks.black_dn, gain, _read_noise_e(darks, gain), flats.white_dn, flats.bend_per_dn)
        return Calibration(
            psfs=psfs,
            sensor=sensor,
            geometry=geometry,
            field_deg=spec.optics.field_deg if spec.optics else None,
            dark_dn=darks.map_dn,
            flat=flats.response,
            bad=darks.hot | flats.dead,
            simulated=self.steps.simulated,
        )

    def _provenance(self, figures: dict[str, float]) -> Provenance:
        warm_c = self.warmth.read_c() if self.warmth is not None else None
        job, leds = self.job, self.job.leds
        if leds is not None:
            figures = figures | leds.figures
        who = job.serial, self.clock.wall(), job.made_by, job.software
        return Provenance(*who, warm_c, tuple(figures.items()), meter=leds.measured if leds else None)


def _read_noise_e(darks: Darks, gain_e_per_dn: float) -> float:
    """Without the shot noise of what warmth brought in the shortest exposure; electrons."""
    warmth_e = darks.dark_dn_per_s * darks.shortest_s * gain_e_per_dn
    return sqrt(max((darks.read_noise_dn * gain_e_per_dn) ** 2 - max(warmth_e, 0.0), 0.0))


def numbers_of(step: Darks | Flats | Point) -> dict[str, float]:
    """The single numbers of a step, and of each map of marked pixels their count."""
    found: dict[str, float] = {}
    for key, value in vars(step).items():
        if isinstance(value, float):
            found[key] = value
        elif isinstance(value, np.ndarray) and value.dtype == bool:
            found[key] = float(value.sum())
    return found


def _figures(darks: Darks, flats: Flats, point: Point) -> dict[str, float]:
    """What was found besides the calibration itself, for whoever asks years later."""
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


def _said(dioptres: Dioptres | None) -> dict[str, float]:
    if dioptres is None:
        return {}
    return {
        "scale_per_dpt": dioptres.scale_per_dpt,
        "scale_per_dpt_sd": dioptres.sd_per_dpt,
        "dioptres_worst_dpt": dioptres.worst_dpt,
    }
