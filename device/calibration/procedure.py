"""The order of a calibration: cap, even screen, point source; what was measured before a power cut is kept.

WORK/darks.npz, flats.npz    steps that are done, taken up again for half a day
ARCHIVE                      changed by the last line only: until then the old calibration stays in force
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from datetime import datetime, timedelta
from math import sqrt
from pathlib import Path
from typing import Literal, TypeVar
from zipfile import BadZipFile

import numpy as np

from device.calibration.archive import Archive, Provenance, sync_folder, write_synced
from device.calibration.darks import Darks, measured_darks
from device.calibration.flats import LEAST_SHARE, Flats, measured_flats
from device.calibration.moments import Moments
from device.calibration.point import LEAST_PEAK, Point, Steady, measured_point
from device.clock import Clock
from device.errors import CalibrationRefused
from device.ports import Camera, Thermometer
from device.spec import InstrumentSpec
from device.values import Calibration, Counts, Frame, Sensor, Shot

Stand = Literal["cap", "screen", "point"]
Step = TypeVar("Step", Darks, Flats)

SHORTEST_S, LONGEST_S = 1e-3, 10.0
FRAMES = 16
MANY = 32  # darks, whose noise is small
LEVELS = (0.1, 0.2, 0.4, 0.7, 1.0, 1.15)  # of the exposure that fills the wells to FILLED
TOO_BRIGHT = 2.2
FILLED = 0.7
BRACKETS = ((1.0, 16), (4.0, 8), (16.0, 4))  # of the shortest exposure of the point, and how many frames
KEPT_FOR = timedelta(hours=12)


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
    """One calibration of one head: who makes it, and through which source, `source_deg` wide as the head sees it."""

    spec: InstrumentSpec
    serial: str
    made_by: str
    software: str
    source_deg: float = 0.0


class Procedure:
    """Measures a head step by step. Every error leaves the steps before it kept, and the archive as it was."""

    def __init__(
        self, job: Job, camera: Camera, operator: Operator, clock: Clock, work: Path, warmth: Thermometer | None = None
    ) -> None:
        self.job, self.camera, self.operator, self.clock, self.work = job, camera, operator, clock, work
        self.warmth = warmth
        self.simulated = False
        self._counts: Counts = np.empty(camera.shape, np.uint16)

    def run(self, archive: Archive) -> str:
        """All steps that are not done yet; the new calibration is in force when this returns its id.

        Raises CalibrationRefused with the step's reason, and whatever the camera raises.
        """
        darks = self._step("darks", Darks, "cap", self._darks)
        flats = self._step("flats", Flats, "screen", lambda: self._flats(darks))
        self.operator.put("point")
        point = self._point(darks, flats)
        self.operator.tell(f"point: {abs(point.off_px[0])}, {abs(point.off_px[1])} pixels off the middle")
        self.operator.found("point", numbers_of(point))
        calibration = self._assembled(darks, flats, point)
        said = self._provenance(_figures(darks, flats, point))
        id = archive.keep(calibration, said)
        for name in ("darks", "flats"):
            self._path(name).unlink(missing_ok=True)
        return id

    def _step(self, name: str, kind: type[Step], stand: Stand, measure: Callable[[], Step]) -> Step:
        """What was measured before, if it is of this head and of today; else the step itself, kept at once."""
        found = self._taken_up(name, kind)
        if found is not None:
            self.operator.tell(f"{name}: measured before, taken up again")
            self.operator.found(stand, numbers_of(found))
            return found
        self.operator.put(stand)
        measured = measure()
        out = io.BytesIO()
        np.savez(out, whose=self._whose, made_at=self.clock.wall().isoformat(), **vars(measured))
        self.work.mkdir(parents=True, exist_ok=True)
        part = self.work / f".{name}"
        write_synced(part, out.getvalue())
        part.replace(self._path(name))
        sync_folder(self.work)
        self.operator.tell(f"{name}: done")
        self.operator.found(stand, numbers_of(measured))
        return measured

    def _taken_up(self, name: str, kind: type[Step]) -> Step | None:
        try:
            with np.load(io.BytesIO(self._path(name).read_bytes()), allow_pickle=False) as held:
                age = self.clock.wall() - datetime.fromisoformat(held["made_at"].item())
                if held["whose"].item() != self._whose or not timedelta(0) <= age < KEPT_FOR:
                    return None
                read = {field.name: held[field.name] for field in fields(kind)}
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None  # not there, or damaged: it is measured again
        return kind(**{key: value if value.ndim else value.item() for key, value in read.items()})

    @property
    def _whose(self) -> str:
        return repr((self.job.serial, self.job.spec.name, self.job.spec.camera))

    def _path(self, name: str) -> Path:
        return self.work / f"{name}.npz"

    def _darks(self) -> Darks:
        picture_s = self.job.spec.camera.exposure_s
        exposures = [self._moments(each_s, MANY) for each_s in (SHORTEST_S, picture_s, min(4 * picture_s, LONGEST_S))]
        return measured_darks(exposures, picture_s, self.job.spec.camera.white_dn)

    def _flats(self, darks: Darks) -> Flats:
        full_s = self._exposure_for(FILLED, darks, 50.0, 3.0, LEAST_SHARE)
        levels = [self._moments(share * full_s, FRAMES) for share in LEVELS]
        return measured_flats(levels, self._moments(TOO_BRIGHT * full_s, 2), darks)

    def _point(self, darks: Darks, flats: Flats) -> Point:
        first_s = self._exposure_for(FILLED, darks, 100.0, 0.6, LEAST_PEAK)
        exposures = []
        for factor, count in BRACKETS:
            exposure_s = min(factor * first_s, LONGEST_S)
            frames = Steady(darks.at(exposure_s)).watch(self._frames(exposure_s, count))
            exposures.append(Moments.over(frames, self.camera.shape, exposure_s))
        return measured_point(exposures, darks, flats, self._disc_px())

    def _disc_px(self) -> float:
        optics, pitch_um = self.job.spec.optics, self.job.spec.camera.pitch_um
        return self.job.source_deg * optics.geometry(pitch_um).px_per_deg if optics else 0.0

    def _moments(self, exposure_s: float, count: int) -> Moments:
        return Moments.over(self._frames(exposure_s, count), self.camera.shape, exposure_s)

    def _frames(self, exposure_s: float, count: int) -> Iterator[Frame]:
        """One buffer for all of them: who wants to keep a frame keeps its mean."""
        self.camera.prepare(Shot(exposure_s))
        for _ in range(count):
            frame = self.camera.expose(Shot(exposure_s), self._counts)
            self.simulated |= frame.simulated
            yield frame

    def _exposure_for(self, filled: float, darks: Darks, percentile: float, longest_s: float, least: float) -> float:
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

    def _assembled(self, darks: Darks, flats: Flats, point: Point) -> Calibration:
        spec, gain = self.job.spec, flats.gain_e_per_dn
        sensor = Sensor(darks.black_dn, gain, _read_noise_e(darks, gain), flats.white_dn)
        return Calibration(
            psfs=(point.psf,),
            sensor=sensor,
            geometry=spec.optics.geometry(spec.camera.pitch_um) if spec.optics else None,
            field_deg=spec.optics.field_deg if spec.optics else None,
            dark_dn=darks.map_dn,
            flat=flats.response,
            bad=darks.hot | flats.dead,
            simulated=self.simulated,
        )

    def _provenance(self, figures: dict[str, float]) -> Provenance:
        warm_c = self.warmth.read_c() if self.warmth is not None else None
        job = self.job
        return Provenance(job.serial, self.clock.wall(), job.made_by, job.software, warm_c, tuple(figures.items()))


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
