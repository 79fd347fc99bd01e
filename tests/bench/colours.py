"""`make bench-frames`, part `colours`: shift errors, PSNR and colour differences of frames in three colours of light.

The planes of a photograph are not registered themselves: the camera's lateral colour moves them by up to a pixel. The
column "own" is what the same registration finds between the planes without optics and noise.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from device.recon.assessment.metrics import fit_intensity
from device.recon.colour import join_colours, register_colours
from device.recon.estimation.registration import Shift
from device.recon.model.grid import disc
from device.recon.model.resampling import moved_back
from device.recon.reconstructor import Reconstructor
from device.recon.stage import default_schedule
from device.values import Colour, Image
from tests.bench import timing
from tests.bench.bursts import CLOCK, PLANNER, scored, scorer
from tests.bench.colour_difference import ciede2000, lab
from tests.bench.moving_eye import (
    CHANNEL_PLANE,
    COLOURS,
    FIELDS,
    PAPER,
    calibrated,
    counted,
    exposed,
    eye_dpt,
    field_px,
    photograph,
    retina,
    wave_psf,
)

PEAK_E = {"red": 20000.0, "green": 20000.0, "blue": 5000.0}
FARTHEST_PX = 7.0
FITTED = ("06_dr", "07_h", "09_g", "cc0")  # photographs of the coefficients of a predicted blue
MOVED: tuple[Colour, ...] = ("red", "blue")
EVERY = 7  # pixel whose colour is compared

Pictures = dict[Colour, Image]


def colours(folder: Path, names: Sequence[str] = tuple(FIELDS)) -> None:
    """Print per field what became of its colours, and the means; held-out photographs apart."""
    makers = {}
    for colour in COLOURS:
        calibration = calibrated(PAPER, colour)
        steps = default_schedule(calibration, PAPER.shape)
        makers[colour] = Reconstructor(calibration, PAPER.shape, PLANNER, CLOCK, steps, timed=False)
    n, random = makers["green"].stages[-1].grid.n, np.random.default_rng(7)
    timing.head(
        "20 ke- red and green, 5 ke- blue",
        "red px",
        "own",
        "blue px",
        "own",
        "red dB",
        "guided",
        "blue dB",
        "guided",
        "dE00",
        "no blue",
        "doubtful",
    )
    rows: list[list[float]] = []
    for k, name in enumerate(names):
        file, place = FIELDS[name]
        planes = photograph(folder / file, place, PAPER)
        shifts: dict[Colour, Shift] = {}
        made: Pictures = {}
        for c in COLOURS:
            row, col = random.uniform(-FARTHEST_PX, FARTHEST_PX, 2)
            shifts[c] = (0.0, 0.0) if c == "green" else (float(row), float(col))
            plane = retina(planes[..., CHANNEL_PLANE[c]], PAPER, shifts[c])
            light = exposed(plane, wave_psf(PAPER, c, eye_dpt(c)))
            counts = counted(light * np.float32(PEAK_E[c] / light.max()), PAPER, 100 * k + CHANNEL_PLANE[c])
            made[c] = makers[c](counts).picture
        rows.append(_judge(name, made, planes, shifts, n))
    found = np.array(rows)
    timing.row("rms of the shifts, mean of the others", *_rms(found[:, :4]), *found[:, 4:].mean(axis=0))
    held = np.array([not field_name.startswith(FITTED) for field_name in names])
    if held.any() and not held.all():
        timing.row("photographs that gave no coefficient", *_rms(found[held, :4]), *found[held, 4:].mean(axis=0))


def _rms(values: NDArray[np.float64]) -> list[float]:
    return [float(rms) for rms in np.sqrt((values**2).mean(axis=0))]


def _judge(name: str, made: Pictures, planes: Image, shifts: dict[Colour, Shift], n: int) -> list[float]:
    """Print and return the figures of one field: four rms errors per axis in px, four PSNR, two mean dE00."""
    lit = disc(PAPER.shape, ((PAPER.rows - 1) / 2, (PAPER.cols - 1) / 2), field_px(PAPER) / 2)
    truth: Pictures = {c: retina(planes[..., CHANNEL_PLANE[c]], PAPER) for c in COLOURS}
    own, _ = register_colours(truth, "green", lit, n)
    joined = join_colours(made, lit, n)
    without = join_colours({"red": made["red"], "green": made["green"]}, lit, n).picture
    found = {channel.name: channel.shift_px or (0.0, 0.0) for channel in joined.channels}
    plain = {name: moved_back(picture, np.ones_like(picture), found[name])[0] for name, picture in made.items()}
    db, errors = [], []
    for c in MOVED:
        score = scorer(truth[c])
        db += [score(picture).psnr_db for picture in (plain[c], joined.picture[..., CHANNEL_PLANE[c]])]
        off = np.subtract(found[c], shifts[c])
        errors += [float(np.sqrt((off**2).mean())), float(np.sqrt(np.square(own[c]).mean()))]
    differences = [_difference(picture, truth, scored()) for picture in (joined.picture, without)]
    timing.row(name, *errors, *db, *differences, str(len(joined.doubtful)))
    return [*errors, *db, *differences]


def _difference(picture: Image, truth: Pictures, inside: NDArray[np.bool_]) -> float:
    """Return the mean dE00 inside, each channel fitted to the truth by gain and offset."""
    ours, theirs = [], []
    for c in COLOURS:
        t, x = truth[c].astype(np.float64), picture[..., CHANNEL_PLANE[c]].astype(np.float64)
        ours.append(fit_intensity(x, t, inside)[inside][::EVERY])
        theirs.append(t[inside][::EVERY])
    left, right = (np.clip(np.stack(values, axis=1), 0, 1) for values in (ours, theirs))
    return float(ciede2000(lab(left), lab(right)).mean())
