"""Flicker: bands of a rolling shutter under a lamp that flickers, as a gain of each row; NUMERICS.md 3.9.

Rows are read one after the other, so each sees another part of the lamp's period: the frame is that of a steady lamp
times a periodic function of the row. The row means show it as a narrow line in their spectrum. A pattern of horizontal
lines in the object shows the same line, but the forward model explains it: the caller compares the misfits of the frame
with and without the gain.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.model.kernels import Pixels
from device.values import Image

Series = NDArray[np.float64]

DEGREE = 12  # of the polynomial that holds the steady profile of the rows
MIN_CYCLES = 5  # over the lit rows: fewer are shading, too
MIN_AMPLITUDE = 0.004  # of the light: clean frames up to 0.002
MIN_RATIO = 30.0  # of the line to its neighbours in the spectrum: clean frames up to 10, reflexes 18
SPOT_MIN_RATIO = 10.0  # behind lenslets, whose rows show the retina: a clean frame 4.5, bands of 5 % 26
NEIGHBOURS = 40  # cycles over the lit rows
HARMONICS = 24  # the ninth of a triangle still has 1 % of its amplitude
FEW_HARMONICS = 3  # with which the period is found
ZEROS = 4  # the spectrum has so many values per cycle over the lit rows
MIN_LIT = 0.05  # of the brightest row
REFINEMENTS = 3
MIN_ROWS = 64


class SteadyFrame(NamedTuple):
    """Counts as under a steady lamp, float32; the rms of the gains of its rows, minus 1, that were taken out."""

    counts: Image
    flicker: float


class _Profile(NamedTuple):
    """Logarithm of the row means of the lit rows, and the polynomials (rows, DEGREE + 1) of their steady part."""

    first: int
    log_light: Series
    polynomials: Series


class FlickerFinder:
    """Search for flicker in frames with this dark frame, (rows, cols) or (1, cols), and this white level.

    `min_ratio`: of the line of the row means to its neighbours.
    """

    def __init__(self, dark: Image, white_dn: float, min_ratio: float = MIN_RATIO) -> None:
        self._dark, self._white_dn, self._min_ratio = dark, white_dn, min_ratio

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> SteadyFrame | None:
        """Return a frame, (rows, cols) or (rows, cols, 3), without its flicker; None if its row means show none.

        `dark` is the dark frame of this shot, None: that of the calibration. All channels of a frame have the gain of
        their mean. Saturated pixels keep their counts.
        """
        offset = self._dark if dark is None else np.asarray(dark, np.float32)
        offset = offset if offset.ndim == counts.ndim else offset[..., None]
        others = tuple(range(1, counts.ndim))
        seen = np.isfinite(counts)
        light = np.where(seen, counts - offset, 0).sum(others, dtype=np.float64)
        gain = row_gain(light / np.maximum(seen.sum(others), 1), self._min_ratio)
        if gain is None:
            return None
        steady = (counts - offset) / gain.astype(np.float32).reshape(-1, *(1 for _ in others)) + offset
        below = np.nextafter(np.float32(self._white_dn), np.float32(0))
        steady = np.where(counts >= self._white_dn, np.float32(self._white_dn), np.minimum(steady, below))
        return SteadyFrame(np.asarray(steady, np.float32), float(gain.std()))


def row_gain(light_dn: Series, min_ratio: float = MIN_RATIO) -> Series | None:
    """Return the periodic gain of each row that the row means (rows,) show, mean about 1.

    None without a line in their spectrum that is `min_ratio` times its neighbours.
    """
    profile = _profile(light_dn)
    if profile is None:
        return None
    steady = np.linalg.lstsq(profile.polynomials, profile.log_light, rcond=None)[0]
    cycles = _line(profile.log_light - profile.polynomials @ steady, min_ratio)
    if cycles is None:
        return None
    gain = np.ones(len(light_dn))
    log_gain = _periodic_part(profile, cycles)
    gain[profile.first : profile.first + len(log_gain)] = np.exp(log_gain)
    return gain


def _profile(light_dn: Series) -> _Profile | None:
    """Return the profile of the lit rows, from the first to the last one; None with fewer than MIN_ROWS."""
    lit = np.flatnonzero(light_dn > MIN_LIT * light_dn.max())
    if not lit.size or lit[-1] - lit[0] < MIN_ROWS:
        return None
    first, last = int(lit[0]), int(lit[-1])
    light = np.maximum(light_dn[first : last + 1], MIN_LIT * light_dn.max())
    polynomials = np.asarray(chebyshev.chebvander(np.linspace(-1, 1, len(light)), DEGREE), np.float64)
    return _Profile(first, np.log(light), polynomials)


def _line(left: Series, min_ratio: float) -> float | None:
    """Return the cycles over all rows of the strongest line in the spectrum of `left`; None if none is narrow."""
    rows = len(left)
    window = np.hanning(rows + 2)[1:-1]
    amplitude = np.abs(np.fft.rfft((left - np.average(left, weights=window)) * window, ZEROS * rows)) * 2 / window.sum()
    near = ndimage.median_filter(amplitude, ZEROS * NEIGHBOURS + 1)
    best = ZEROS * MIN_CYCLES + int(np.argmax(amplitude[ZEROS * MIN_CYCLES :]))
    is_narrow = amplitude[best] >= max(MIN_AMPLITUDE, min_ratio * near[best])
    return best / ZEROS if is_narrow else None


def _periodic_part(profile: _Profile, cycles: float) -> Series:
    """Return the periodic part of the profile: HARMONICS of the line near `cycles` over all rows."""
    step = 1 / ZEROS
    for _ in range(REFINEMENTS):
        near = [cycles + step * k / 4 for k in range(-4, 5)]
        cycles = min(near, key=lambda value: _fitted(profile, value, FEW_HARMONICS)[1])
        step /= 4
    return _fitted(profile, cycles, HARMONICS)[0]


def _fitted(profile: _Profile, cycles: float, harmonics: int) -> tuple[Series, float]:
    """Return the periodic part of the least-squares fit with these cycles over all rows, and the squares it leaves.

    Of the harmonics only those below half a cycle per row are fitted.
    """
    rows = len(profile.log_light)
    orders = np.arange(1, min(harmonics, int(rows / 2 / cycles - 0.5)) + 1)
    phases = 2 * np.pi * cycles / rows * np.arange(rows)[:, None] * orders
    functions = np.concatenate([profile.polynomials, np.cos(phases), np.sin(phases)], axis=1)
    found = np.linalg.lstsq(functions, profile.log_light, rcond=None)[0]
    left = profile.log_light - functions @ found
    constants = profile.polynomials.shape[1]
    return functions[:, constants:] @ found[constants:], float(left @ left)
