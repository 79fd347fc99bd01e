"""Noise of the columns (or rows) of a sensor: an offset or a gain that all pixels of a line share; NUMERICS.md 6.3.

Across the lines the frame is divided into bands. What all bands share, an offset alike, a gain in proportion to their
light, is their mean, weighted by the inverse variance of each band, which its difference to its neighbours shows: bands
without light weigh most. Neither object nor noise of pixels has fine structure in this mean; the noise of lines is
white. A Wiener filter with its variance takes it out where the object is weaker.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from device.values import Image

Series = NDArray[np.float64]

BANDS = 16  # across the lines
MIN_LINES = 64
# Variance of the fine structure over that of the pixels' noise, less 1, times the root of the number of lines: the
# standard deviation of white noise is 4. Clean frames have up to 9.
MIN_EXCESS = 22.0
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 70**0.5  # differences, of variance 1 for white noise
NORMAL = 0.455  # median of z^2, standard normal z
NOISE_WIDTH = 121  # lines, over which the noise of a band is averaged
LEVEL_WIDTH = 61  # lines, whose mean is the light near one
EXCESS_WIDTH = 31  # frequencies, over which the power of the object is averaged
MAX_EXCESS = 9.0  # of a frequency's power over the mean: more is a pattern of lines in the object
DEAD = 0.5  # of the light of the lines around it: a line with less is dead, and has no offset
DEAD_WIDTH = 25
MIN_LIGHT = 0.1  # of the brightest lines
BISECTIONS = 30
FAINT = 1e-30


class LineNoise(NamedTuple):
    """Noise of the lines: offset in DN and gain (lines,), float32, of which one or both may vary; rms of both in DN."""

    offset_dn: Image
    gain: Image
    rms_dn: float


class _Mean(NamedTuple):
    """Mean of the bands less the light near each line, and the variance of its noise, (lines,): DN, or shares."""

    value: Series
    variance: Series

    @property
    def sharp(self) -> tuple[Series, Series]:
        """Squares of the fine structure, and the variances of the noise, of the half of the lines with less noise."""
        seen = self.variance[np.isfinite(self.variance)]
        least = self.variance <= (np.median(seen) if seen.size else 0)
        return _fourth(self.value)[least] ** 2, self.variance[least]

    @property
    def excess(self) -> float:
        """Significance of the noise of lines: see MIN_EXCESS."""
        squares, variance = self.sharp
        return (float(np.median(squares / variance)) / NORMAL - 1) * squares.size**0.5 if squares.size else 0.0


def line_noise(bands: Image) -> LineNoise | None:
    """Return the noise of the lines from their mean light in DN in each of the bands, (bands, lines).

    None without a significant one.
    """
    if len(bands) < BANDS or bands.shape[1] < MIN_LINES:
        return None
    light = np.asarray(bands, np.float64)
    excesses = {is_gain: mean.excess for is_gain, mean in _means(light).items()}
    if max(excesses.values()) <= MIN_EXCESS:
        return None
    light = _without_dead(light)
    parts = {is_gain: np.zeros(light.shape[1]) for is_gain in excesses}
    for is_gain in sorted(excesses, key=lambda key: -excesses[key]):
        mean = _means(light)[is_gain]
        if mean.excess > MIN_EXCESS:
            parts[is_gain] = _shared(mean)
            light = light - parts[is_gain] * (light if is_gain else 1)
    if not any(part.any() for part in parts.values()):
        return None
    rms_dn = float((parts[False] + parts[True] * _level(light).mean(axis=0)).std())
    return LineNoise(np.asarray(parts[False], np.float32), np.asarray(1 + parts[True], np.float32), rms_dn)


def _fourth(values: Series) -> Series:
    return np.asarray(ndimage.convolve1d(values, FOURTH, axis=-1))


def _level(light: Series) -> Series:
    """Return the light near each line in each band, in DN, (bands, lines)."""
    return np.asarray(ndimage.uniform_filter1d(light, LEVEL_WIDTH, axis=1))


def _means(light: Series) -> dict[bool, _Mean]:
    """Return the means of the bands in DN (False), in which offsets stand out, and in shares of the light (True)."""
    level = _level(light)
    lit = level > MIN_LIGHT * level.max()
    shares = np.divide(light - level, level, out=np.zeros_like(level), where=lit)
    return {False: _mean(light - level, np.ones_like(lit)), True: _mean(shares, lit)}


def _mean(light: Series, lit: NDArray[np.bool_]) -> _Mean:
    """Return the mean of the bands where they are lit, with the inverses of their variances as weights."""
    both = ndimage.uniform_filter1d(_fourth(np.diff(light, axis=0)) ** 2, NOISE_WIDTH, axis=1)
    both = np.pad(
        np.maximum(both, 0), ((1, 1), (0, 0)), mode="edge"
    )  # variances of differences: the noise of two bands
    variance = np.sqrt(both[:-1] * both[1:]) / 2
    weight = np.divide(1, variance, out=np.zeros_like(variance), where=lit & (variance > 0))  # 0: clipped
    total = weight.sum(axis=0)
    return _Mean(
        (weight * light).sum(axis=0) / np.maximum(total, FAINT),
        np.divide(1, total, out=np.full_like(total, np.inf), where=total > 0),
    )


def _without_dead(light: Series) -> Series:
    """Return the bands with the median of the surroundings in place of lines without light."""
    around = ndimage.median_filter(light, (1, DEAD_WIDTH))
    level_dn = around.mean(axis=0)
    dead = (light.mean(axis=0) < DEAD * level_dn) & (level_dn > MIN_LIGHT * level_dn.max())
    return np.where(dead, around, light)


def _shared(mean: _Mean) -> Series:
    """Return what the lines of all bands share, beside object and noise, (lines,)."""
    squares, variance = mean.sharp
    low, high = 0.0, float(squares.max())
    for _ in range(BISECTIONS):  # the variance for which the median of the normalised squares is that of normal values
        own = (low + high) / 2
        low, high = (own, high) if np.median(squares / (own + variance)) > NORMAL else (low, own)
    spectrum = fft.dct(mean.value, norm="ortho")
    power = spectrum**2
    others = np.maximum(ndimage.uniform_filter1d(power, EXCESS_WIDTH) - own, 0)  # object, and noise
    weight = own / np.maximum(own + others, power / MAX_EXCESS)
    return np.asarray(fft.idct(weight * spectrum, norm="ortho"))
