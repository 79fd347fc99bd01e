"""`make bench-frames`, part `bursts`: what the frames of a burst gain over one frame, beside as much light in one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from device.clock import SystemClock
from device.recon.assessment.metrics import PictureScorer
from device.recon.burst import BurstJoiner, JoinedFrame
from device.recon.model.fft_plans import Planner
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor, default_schedule
from device.values import Calibration, Counts, Image, Mask
from tests.bench import timing
from tests.bench.moving_eye import (
    BLACK_DN,
    FIELDS,
    PAPER,
    calibrated,
    counted,
    exposed,
    field_px,
    photograph,
    retina,
    wave_psf,
)

PEAK_E, DRIFT_PX, MOST = 15000.0, 2.5, 8
COUNTS = (2, 4, 8)
SIX = ("06_dr a", "07_h b", "09_g a", "cc0 a", "01L", "05R")
PLANNER, CLOCK = Planner(Path.home() / ".cache" / "diffuscope"), SystemClock()
Places = list[tuple[float, float]]


def solved(counts: Counts | Image, calibration: Calibration) -> Image:
    """Return the picture of a frame, or of a joined one, by the stage that the instrument shows."""
    shape = (counts.shape[0], counts.shape[1])
    last = default_schedule(calibration, shape)[-1]
    return Reconstructor(calibration, shape, PLANNER, CLOCK, (last,), timed=False)(counts).picture


def drift(seed: int) -> Places:
    """Return the places of an eye that drifts DRIFT_PX a frame and axis at random, from (0, 0) on."""
    steps = np.random.default_rng(seed).normal(0, DRIFT_PX, (MOST, 2))
    steps[0] = 0
    return [(float(r), float(c)) for r, c in np.cumsum(steps, axis=0)]


def scored() -> Mask:
    """Return the part of the field that all frames share, (rows, cols)."""
    centre = ((PAPER.rows - 1) / 2, (PAPER.cols - 1) / 2)
    return disc(PAPER.shape, centre, field_px(PAPER) / 2 - 24) > 0.5


def scorer(truth: Image) -> PictureScorer:
    """Return the scorer within the field that all frames share."""
    return PictureScorer(truth, scored(), 32.0)


def frames(plane: Image, places: Places, psf: Image, seed: int) -> tuple[list[Counts], Image]:
    """Return a frame of each place, and the light of a still eye in one frame in electrons."""
    still = exposed(retina(plane, PAPER), psf)
    scale = np.float32(PEAK_E / still.max())
    lights = [exposed(retina(plane, PAPER, one), psf) * scale for one in places]
    return [counted(light, PAPER, seed + k) for k, light in enumerate(lights)], still * scale


def bursts(folder: Path, names: Sequence[str] = SIX) -> list[list[float]]:
    """Print per photograph dB over one frame of 2, 4 and 8 frames, and of a still eye with as much light."""
    calibration, psf = calibrated(PAPER, "green"), wave_psf(PAPER, "green")
    joiner = BurstJoiner(calibration, PAPER.shape, PLANNER, CLOCK)
    gains, columns = [], [f"{n} {kind}" for n in COUNTS for kind in ("gain", "ideal")]
    timing.head(f"burst, {PEAK_E / 1000:g} ke- a frame, {DRIFT_PX} px", "one dB", *columns, "px rms")
    for k, name in enumerate(names):
        file, place = FIELDS[name]
        plane, places = photograph(folder / file, place, PAPER)[..., 1], drift(40 + k)
        shots, still_e = frames(plane, places, psf, 100 * k)
        score = scorer(retina(plane, PAPER))
        one_db = score(solved(shots[0], calibration)).psnr_db
        cells, off = [], np.nan
        for n in COUNTS:
            joined = joiner(shots[:n])
            off = registration_error(joined, places)
            ideal = [counted(still_e, PAPER, 100 * k + 50 + i) for i in range(n)]
            total = np.asarray(np.mean(ideal, axis=0) - BLACK_DN, np.float32)
            cells += [
                score(solved(joined.counts, joined.calibration)).psnr_db - one_db,
                score(solved(total, joined.calibration)).psnr_db - one_db,
            ]
        gains.append(cells)
        timing.row(name, one_db, *cells, off)
    timing.row("mean", None, *np.mean(gains, axis=0))
    return gains


def registration_error(joined: JoinedFrame, places: Places) -> float:
    """Return the rms error of the shifts about their mean, px per axis."""
    errors = np.array([
        np.subtract(one.shift_px, places[one.index]) for one in joined.frames if one.shift_px is not None
    ])  # fmt: skip
    return float(np.sqrt(((errors - errors.mean(axis=0)) ** 2).mean()))
