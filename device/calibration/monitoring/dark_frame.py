"""Assessment of the dark frame of an ordinary capture: black level, noise and new hot pixels."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from device.calibration.archive import Provenance
from device.values import Calibration, Counts, Image

PARTS = 8  # x 8 parts of the frame; the darkest replaces the dark rows that these sensors lack
HOT_SIGMAS, HOT_DN = 10.0, 3.0  # of one frame's noise and the pixels' spread: a normal pixel never exceeds them
SUBSAMPLE_STEP = 7  # pixel step of the subsample for percentiles
ROUNDED_DN = 12**-0.5  # largest quantisation noise; a smaller noise is hidden by it


@dataclass(frozen=True)
class DarkFrameAssessment:
    """Differences of one dark frame from the calibration.

    `black_off_dn` is the mean difference in its darkest part; `noise_ratio` the spread of its pixels over the largest
    expected spread of rounded counts (None if the calibration lacks it); `hot` holds the flat indices of bright pixels
    that are not marked bad; `dark_current_dn` is the signal of the dark current at the calibration's temperature, DN.
    """

    black_off_dn: float
    noise_ratio: float | None
    hot: NDArray[np.int64]
    dark_current_dn: float


def assess_dark_frame(
    calibration: Calibration,
    provenance: Provenance | None,
    counts: Counts,
    exposure_s: float,
    between: Callable[[], None] = lambda: None,
) -> DarkFrameAssessment:
    """Return the assessment of a dark frame (rows, cols) of `exposure_s`; `between` is called between its steps."""
    figures = dict(provenance.figures) if provenance is not None else {}
    gain = calibration.sensor.gain_e_per_dn
    black_dn = calibration.sensor.black_dn
    warmth_dn = figures.get("dark_e_per_s", 0.0) * exposure_s / gain if gain else 0.0
    level_dn = calibration.dark_dn if calibration.dark_dn is not None else np.float32(black_dn + warmth_dn)
    off: Image = counts.astype(np.float32) - level_dn
    good = np.ones(off.shape, np.bool_) if calibration.bad is None else ~calibration.bad
    sigma_dn = _sigma_dn(calibration, figures, warmth_dn)
    between()
    low_dn, middle_dn, high_dn = np.percentile(
        off.ravel()[::SUBSAMPLE_STEP][good.ravel()[::SUBSAMPLE_STEP]], (15.87, 50.0, 84.13)
    )
    far_dn = HOT_DN + HOT_SIGMAS * max(sigma_dn or 0.0, float(high_dn - low_dn) / 2)  # the spread includes room light
    between()
    hot = _isolated(off, np.flatnonzero(good & (off > middle_dn + far_dn)), far_dn, gain or 1.0)
    good &= np.abs(off - np.float32(middle_dn)) <= far_dn
    between()
    noise = None
    if sigma_dn is not None:
        flat = off if calibration.dark_dn is not None else counts.astype(np.float32)
        noise = float(flat[good].std(dtype=np.float64)) / hypot(sigma_dn, ROUNDED_DN)
    between()
    return DarkFrameAssessment(_darkest_dn(off, good), noise, hot, warmth_dn)


def _sigma_dn(calibration: Calibration, figures: dict[str, float], warmth_dn: float) -> float | None:
    """Return the expected noise, DN: read noise, dark-current noise, and DSNU without a map; None if any is unknown."""
    gain = calibration.sensor.gain_e_per_dn
    read_e = calibration.sensor.read_noise_e
    if gain is None or read_e is None or "pattern_e" not in figures:
        return None
    pattern_e = figures["pattern_e"] if calibration.dark_dn is None else 0.0
    return sqrt(read_e**2 + pattern_e**2 + warmth_dn * gain) / gain


def _isolated(off: Image, bright: NDArray[np.int64], far_dn: float, gain_e_per_dn: float) -> NDArray[np.int64]:
    """Return those of the flat indices `bright` whose pixel exceeds the median of its eight neighbours.

    `off` is the frame less the expected dark frame, DN. The excess must be above `far_dn` plus HOT_SIGMAS times the
    shot noise of that median. This excludes pixels lit by a lamp in the room, because their neighbours are lit too.
    """
    rows, cols = np.unravel_index(bright, off.shape)
    around = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)]
    near = [
        off[np.clip(rows + down, 0, off.shape[0] - 1), np.clip(cols + right, 0, off.shape[1] - 1)]
        for down, right in around
    ]
    level_dn = np.median(near, axis=0)
    shot_dn = np.sqrt(np.maximum(level_dn, 0) / gain_e_per_dn)
    return bright[off.ravel()[bright] > level_dn + far_dn + HOT_SIGMAS * shot_dn]


def _darkest_dn(off: Image, good: NDArray[np.bool_]) -> float:
    """Return the lowest mean of 8 x 8 parts, DN: room light falls on the field only, a black level on every pixel."""
    parts = []
    for rows in np.array_split(np.arange(off.shape[0]), PARTS):
        for cols in np.array_split(np.arange(off.shape[1]), PARTS):
            part = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
            if good[part].any():
                parts.append(float(off[part][good[part]].mean(dtype=np.float64)))
    return min(parts, default=0.0)
