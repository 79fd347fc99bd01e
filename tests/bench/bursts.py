"""`make bench-frames`, part `bursts`: what the frames of a burst gain over one frame, beside as much light in one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from device.clock import SystemClock
from device.recon.assessment.exposure_split import loss_db
from device.recon.assessment.metrics import PictureScorer
from device.recon.burst import BurstJoiner, JoinedFrame
from device.recon.model.fft_plans import Planner
from device.recon.model.grid import disc
from device.recon.reconstructor import Reconstructor
from device.recon.stage import default_schedule
from device.values import Calibration, Counts, Image, Mask, Reconstruction
from tests.bench import timing
from tests.bench.moving_eye import (
    BLACK_DN,
    FIELDS,
    IMX296,
    OPTICS,
    PAPER,
    SensorCase,
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
DIM_E, FAR_PX = 500.0, (0, 8, 15, 30)
SPLIT, SPLIT_CASES = (1, 4, 8), ((20000.0, 4.0), (20000.0, 11.0), (2000.0, 4.0), (2000.0, 12.0))
SIX = ("06_dr a", "07_h b", "09_g a", "cc0 a", "01L", "05R")
PLANNER, CLOCK = Planner(Path.home() / ".cache" / "diffuscope"), SystemClock()
Places = list[tuple[float, float]]


def solved(counts: Counts | Image, calibration: Calibration) -> Image:
    """Return the picture of a frame, or of a joined one, by the stage that the instrument shows."""
    shape = (counts.shape[0], counts.shape[1])
    last = default_schedule(calibration, shape)[-1]
    return Reconstructor(calibration, shape, PLANNER, CLOCK, (last,), timed=False)(counts).picture


def solved_burst(joined: JoinedFrame, first: Counts, calibration: Calibration) -> Image:
    """Return the picture of a joined frame by the stage that the instrument shows, solved as the sum of its frames."""
    solver = Reconstructor(calibration, (first.shape[0], first.shape[1]), PLANNER, CLOCK, timed=False)
    *_, made = solver.steps(first, joined=joined.counts * np.float32(joined.light))
    assert isinstance(made, Reconstruction)
    return made.picture


def drift(seed: int, count: int = MOST) -> Places:
    """Return the places of an eye that drifts DRIFT_PX a frame and axis at random, from (0, 0) on."""
    steps = np.random.default_rng(seed).normal(0, DRIFT_PX, (count, 2))
    steps[0] = 0
    return [(float(r), float(c)) for r, c in np.cumsum(steps, axis=0)]


def scored(sensor: SensorCase = PAPER) -> Mask:
    """Return the part of the field that all frames share, (rows, cols)."""
    centre = ((sensor.rows - 1) / 2, (sensor.cols - 1) / 2)
    return disc(sensor.shape, centre, field_px(sensor) / 2 - 24) > 0.5


def scorer(truth: Image, sensor: SensorCase = PAPER, vessels: Mask | None = None) -> PictureScorer:
    """Return the scorer within the field that all frames share."""
    return PictureScorer(truth, scored(sensor), 32.0, vessels)


def frames(
    plane: Image, places: Places, psf: Image, seed: int, sensor: SensorCase = PAPER, peak_e: float = PEAK_E
) -> tuple[list[Counts], Image]:
    """Return a frame of each place, and the light of a still eye in one frame in electrons."""
    still = exposed(retina(plane, sensor), psf)
    scale = np.float32(peak_e / still.max())
    lights = [exposed(retina(plane, sensor, place), psf) * scale for place in places]
    return [counted(light, sensor, seed + k) for k, light in enumerate(lights)], still * scale


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
                score(solved_burst(joined, shots[0], calibration)).psnr_db - one_db,
                score(solved_burst(JoinedFrame(total, n, ()), shots[0], calibration)).psnr_db - one_db,
            ]
        gains.append(cells)
        timing.row(name, one_db, *cells, off)
    timing.row("mean", None, *np.mean(gains, axis=0))
    return gains


def dim_bursts(folder: Path, names: Sequence[str] = SIX) -> None:
    """Print PCC, and vessel contrast over the truth's, of frames of DIM_E electrons on a cropped sensor (IMX296)."""
    calibration, psf = calibrated(IMX296, "green"), wave_psf(IMX296, "green")
    joiner = BurstJoiner(calibration, IMX296.shape, PLANNER, CLOCK)
    timing.head(
        f"IMX296, {DIM_E:g} e- a frame, {DRIFT_PX} px",
        "1 PCC",
        "8 PCC",
        "16 PCC",
        "1 vess",
        "8 vess",
        "16 vess",
        "px rms",
        "used",
    )
    found = []
    for k, name in enumerate(names):
        file, place = FIELDS[name]
        plane = photograph(folder / file, place, IMX296)[..., 1]
        places = drift(60 + k, 16)
        shots, _ = frames(plane, places, psf, 100 * k, IMX296, DIM_E)
        score = scorer(retina(plane, IMX296), IMX296, _vessels(folder / file, place))
        scores = [score(solved(shots[0], calibration))]
        for n in (8, 16):
            joined = joiner(shots[:n])
            scores.append(score(solved_burst(joined, shots[0], calibration)))
        true = score.truth_contrast
        shares = [
            np.nan if true is None or result.vessel_contrast is None else result.vessel_contrast / true
            for result in scores
        ]
        cells = [*(result.pcc for result in scores), *shares]
        found.append(cells)
        timing.row(name, *cells, registration_error(joined, places), str(sum(use.used for use in joined.frames)))
    timing.row("mean", *np.nanmean(found, axis=0))


def _vessels(file: Path, place: tuple[float, float, float]) -> Mask | None:
    """Return the vessels of a photograph on the cropped sensor as a reader drew them; None where none did."""
    drawn = {
        "hrf": file.parents[1] / "manual1" / f"{file.stem}.tif",
        "chase": file.with_name(f"{file.stem}_1stHO.png"),
    }
    path = next((drawing for name, drawing in drawn.items() if name in file.parts), None)
    return None if path is None else retina(photograph(path, place, IMX296)[..., 1], IMX296) > 0.5


def displaced(folder: Path, names: Sequence[str] = SIX) -> None:
    """Print what four frames gain whose displacements are 0 to 30 px, and eight of which two are bad, over six good."""
    calibration, psf = calibrated(PAPER, "green"), wave_psf(PAPER, "green")
    joiner = BurstJoiner(calibration, PAPER.shape, PLANNER, CLOCK)
    timing.head(
        "displacement of the frames of four, px", *(f"{far}" for far in FAR_PX), "6 good", "8, 2 bad", "left out"
    )
    rows = []
    for k, name in enumerate(names):
        file, place = FIELDS[name]
        plane = photograph(folder / file, place, PAPER)[..., 1]
        score, gains, one_db = scorer(retina(plane, PAPER)), [], 0.0
        for far in FAR_PX:
            places: Places = [(0.0, 0.0), (0.6 * far, 0.8 * far), (-far, 0.3), (0.5, -far)]
            shots, _ = frames(plane, places, psf, 100 * k + far)
            one_db = score(solved(shots[0], calibration)).psnr_db
            joined = joiner(shots)
            gains.append(score(solved_burst(joined, shots[0], calibration)).psnr_db - one_db)
        shots, still_e = frames(plane, drift(40 + k), psf, 100 * k)
        bad = {2: counted(np.full_like(still_e, still_e.mean()), PAPER, 3), 5: _smeared(plane, psf)}
        good = joiner([shot for i, shot in enumerate(shots) if i not in bad])
        mixed = joiner([bad.get(i, shot) for i, shot in enumerate(shots)])
        both = [score(solved_burst(burst, shots[0], calibration)).psnr_db - one_db for burst in (good, mixed)]
        rows.append([*gains, *both])
        left_out = ", ".join(str(use.index) for use in mixed.frames if not use.used)
        timing.row(name, *gains, *both, left_out)
    timing.row("mean", *np.mean(rows, axis=0))


def _smeared(plane: Image, psf: Image) -> Counts:
    """Return a frame during a saccade of 30 px: the mean of seven places."""
    lights = [exposed(retina(plane, PAPER, (0.0, 5.0 * step)), psf) for step in range(7)]
    light = np.asarray(np.mean(lights, axis=0), np.float32)
    return counted(light * np.float32(PEAK_E / light.max()), PAPER, 4)


def registration_error(joined: JoinedFrame, places: Places) -> float:
    """Return the rms error of the shifts about their mean, px per axis."""
    errors = np.array(
        [np.subtract(use.shift_px, places[use.index]) for use in joined.frames if use.shift_px is not None]
    )
    return float(np.sqrt(((errors - errors.mean(axis=0)) ** 2).mean()))


def splits(folder: Path, names: Sequence[str] = SIX[:4]) -> None:
    """Print the loss in dB of one exposure of a moving eye, and of its light in 4 and 8 frames, beside the formula."""
    calibration, psf = calibrated(PAPER, "green"), wave_psf(PAPER, "green")
    joiner = BurstJoiner(calibration, PAPER.shape, PLANNER, CLOCK)
    columns = [f"{n} {kind}" for n in SPLIT for kind in ("loss", "formula")]
    timing.head("one exposure in 1, 4, 8 frames: ke-, motion px", *columns)
    for peak_e, motion_px in SPLIT_CASES:
        lost_db = np.zeros(len(SPLIT))
        mean_e = 0.0
        for k, name in enumerate(names):
            file, place = FIELDS[name]
            plane = photograph(folder / file, place, PAPER)[..., 1]
            still = exposed(retina(plane, PAPER), psf)
            scale, score = np.float32(peak_e / still.max()), scorer(retina(plane, PAPER))
            mean_e += float(still.mean() * scale) / len(names)
            still_db = score(solved(counted(still * scale, PAPER, 900 + k), calibration)).psnr_db
            for column, n in enumerate(SPLIT):
                shots = _parts(plane, psf, n, motion_px, scale, 900 + 100 * k)
                joined = joiner(shots)
                picture = solved_burst(joined, shots[0], calibration) if n > 1 else solved(shots[0], calibration)
                lost_db[column] += (still_db - score(picture).psnr_db) / len(names)
        motion_deg, light = motion_px / OPTICS.geometry(PAPER.pitch_um).px_per_deg, mean_e / PAPER.pitch_um**2
        cells = [cell for n, db in zip(SPLIT, lost_db, strict=True) for cell in (db, loss_db(n, motion_deg, light))]
        timing.row(f"{peak_e / 1000:g} ke-, {motion_px:g} px, {light:.0f} e-/um2", *cells)


def _parts(plane: Image, psf: Image, n: int, motion_px: float, scale: np.float32, seed: int) -> list[Counts]:
    """Return n frames of a steady motion, each as the mean of places one pixel apart; the first is centred on 0."""
    steps, shots = max(int(np.ceil(motion_px / n)), 1), []
    for part in range(n):
        ways_px = motion_px / n * (part - 0.5 + (np.arange(steps) + 0.5) / steps)
        lights = [exposed(retina(plane, PAPER, (0.6 * way_px, 0.8 * way_px)), psf) for way_px in ways_px]
        shots.append(counted(np.asarray(np.mean(lights, axis=0) * scale / n, np.float32), PAPER, seed + part))
    return shots
