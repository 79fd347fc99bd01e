"""What one dark frame of an ordinary press says about the sensor: black level, noise, pixels that turned hot."""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from device.calibration.archive import Provenance
from device.values import Calibration, Counts, Image

PARTS = 8  # x 8 parts of the frame; the darkest stands for a dark row, which these sensors do not give
HOT_SIGMAS, HOT_DN = 10.0, 3.0  # of one frame's noise and the pixels' spread: a normal pixel is beyond in no lifetime
EVERY = 7  # pixels: enough of them for percentiles
ROUNDED_DN = 12**-0.5  # what whole counts add to a noise at the most; where it is smaller they hide it


@dataclass(frozen=True)
class Darkness:
    """One dark frame against the calibration.

    `black_off_dn` is how much brighter its darkest part is; `noisier` the spread of its pixels over the most that is
    expected of whole counts (None: the calibration does not say); `hot` holds the flat indices of pixels that shine and
    are not marked bad; `warmth_dn` is what the sensor's warmth brought when it was calibrated.
    """

    black_off_dn: float
    noisier: float | None
    hot: NDArray[np.int64]
    warmth_dn: float


def darkness(
    calibration: Calibration, known: Provenance | None, counts: Counts, exposure_s: float,
    between: Callable[[], None] = lambda: None,
) -> Darkness:  # fmt: skip
    """A dark frame (rows, cols) of `exposure_s`, judged by what was measured; `between` is called between its steps."""
    figures = dict(known.figures) if known is not None else {}
    gain, black_dn = calibration.sensor.gain_e_per_dn, calibration.sensor.black_dn
    warmth_dn = figures.get("dark_e_per_s", 0.0) * exposure_s / gain if gain else 0.0
    level_dn = calibration.dark_dn if calibration.dark_dn is not None else np.float32(black_dn + warmth_dn)
    off: Image = counts.astype(np.float32) - level_dn
    good = np.ones(off.shape, np.bool_) if calibration.bad is None else ~calibration.bad
    sigma_dn = _sigma_dn(calibration, figures, warmth_dn)
    between()
    low_dn, middle_dn, high_dn = np.percentile(off.ravel()[::EVERY][good.ravel()[::EVERY]], (15.87, 50.0, 84.13))
    far_dn = HOT_DN + HOT_SIGMAS * max(sigma_dn or 0.0, float(high_dn - low_dn) / 2)  # also of a room's light
    between()
    hot = _lonely(off, np.flatnonzero(good & (off > middle_dn + far_dn)), far_dn, gain or 1.0)
    good &= np.abs(off - np.float32(middle_dn)) <= far_dn
    between()
    noise = None
    if sigma_dn is not None:
        flat = off if calibration.dark_dn is not None else counts.astype(np.float32)
        noise = float(flat[good].std(dtype=np.float64)) / hypot(sigma_dn, ROUNDED_DN)
    between()
    return Darkness(_darkest_dn(off, good), noise, hot, warmth_dn)


def _sigma_dn(calibration: Calibration, figures: dict[str, float], warmth_dn: float) -> float | None:
    """The noise of a dark frame's pixels, DN: read noise and that of the warmth, and their pattern if no map has it."""
    gain, read_e = calibration.sensor.gain_e_per_dn, calibration.sensor.read_noise_e
    if gain is None or read_e is None or "pattern_e" not in figures:
        return None
    pattern_e = figures["pattern_e"] if calibration.dark_dn is None else 0.0
    return sqrt(read_e**2 + pattern_e**2 + warmth_dn * gain) / gain


def _lonely(off: Image, bright: NDArray[np.int64], far_dn: float, gain_e_per_dn: float) -> NDArray[np.int64]:
    """Those that also stand out from their neighbours, and from the shot noise of what shines on them: a lamp in the
    room shines on many pixels side by side.
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
    """The mean of the darkest part: room light falls on the field, a black level on every pixel."""
    parts = []
    for rows in np.array_split(np.arange(off.shape[0]), PARTS):
        for cols in np.array_split(np.arange(off.shape[1]), PARTS):
            part = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
            if good[part].any():
                parts.append(float(off[part][good[part]].mean(dtype=np.float64)))
    return min(parts, default=0.0)
