"""Gain step: the columns of a sensor from one place on have another gain than in the flat frame; NUMERICS.md 6.5.

Halves of a sensor have amplifiers of their own, whose gains drift apart. Light behind a diffuser is smooth: no image
has a step in shares of the light that all bands across the columns have in common.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.line_noise import LineNoise
from device.values import Image

Series = NDArray[np.float64]

NORMAL = 0.6745  # median of |z|, standard normal z
SPANS = 120  # in the width of a sensor: columns before and after a place, whose means are compared
MIN_SPAN = 3
MIN_LIGHT = 0.25  # of the brightest place: dim ones, at the edge of the lit disc, are steep
MIN_LIT = 0.5  # of the bands
MIN_SHARE = 0.008  # of the light: a step of 0.01 costs PCC up to 0.004; clean frames have up to 0.007
MAX_SHARE = 0.3  # more is that of dead columns
MIN_SURE = 7.0  # standard errors of the median over the bands
MIN_RATIO = 2.2  # to the largest step within NEAR spans: clean frames past MIN_SURE have up to 1.9, 0.01 has 3.2
NEAR = 20
WORDS = (
    "The gain of the sensor changes by {share:.1%} at column {column}, which the flat frame does not show; it was "
    "evened out. Measure the flat frame again."
)


class GainStep(NamedTuple):
    """Step of the gain: its first column, and the gain from there on over the one before, less 1."""

    column: int
    share: float

    @property
    def words(self) -> str:
        """Message of a report."""
        return WORDS.format(share=abs(self.share), column=self.column)

    def as_noise(self, columns: int) -> LineNoise:
        """Return the gain of each of the columns, with the geometric mean 1 of both parts, as noise without offset."""
        half = np.float32((1 + self.share) ** 0.5)
        gain = np.where(np.arange(columns) < self.column, 1 / half, half)
        return LineNoise(np.zeros_like(gain), gain, 0.0)


def find_gain_step(bands: Image) -> GainStep | None:
    """Return the largest step of the gain in the mean light of bands across the columns, (bands, columns) DN.

    None without a significant one.
    """
    count, columns = bands.shape
    span = max(MIN_SPAN, columns // SPANS)
    places = np.arange(2 * span, columns - 2 * span + 1)
    if count < 2 or places.size < 2 * NEAR * span:
        return None
    shares, lit = _steps(np.asarray(bands, np.float64), places, span)
    seen = lit.sum(axis=0)
    enough = seen >= MIN_LIT * count
    if not enough.any():
        return None
    shares, lit, seen, places = shares[:, enough], lit[:, enough], seen[enough], places[enough]
    step = _median(shares, lit)
    size = np.abs(step)
    large = size > MIN_SHARE
    if not large.any():
        return None
    spread = _median(np.abs(shares - step)[:, large], lit[:, large]) / NORMAL
    is_sure = large.copy()
    is_sure[large] = size[large] > MIN_SURE * spread * np.sqrt(np.pi / 2 / seen[large])
    best = int(np.argmax(np.where(is_sure, size, 0)))
    away = np.abs(places - places[best])
    near = size[(away > 2 * span) & (away <= NEAR * span)].max(initial=0.0)
    is_step = is_sure[best] and MIN_RATIO * near < size[best] < MAX_SHARE
    return GainStep(int(places[best]), float(step[best] / (1 - step[best] / 2))) if is_step else None


def _median(values: Series, lit: NDArray[np.bool_]) -> Series:
    """Return the median over the lit bands at each place, (places,); `np.nanmedian` takes five times as long."""
    rising = np.sort(np.where(lit, values, np.inf), axis=0)
    last = lit.sum(axis=0)[None] - 1
    middle = [np.take_along_axis(rising, index, axis=0)[0] for index in (last // 2, (last + 1) // 2)]
    return np.asarray(sum(middle) / 2)


def _steps(bands: Series, places: NDArray[np.intp], span: int) -> tuple[Series, NDArray[np.bool_]]:
    """Return the step at each place, beyond the slope beside it, over the mean light there, and where that is lit."""
    sums = np.cumsum(np.pad(bands, ((0, 0), (1, 0))), axis=1)
    far, before, after, beyond = np.diff([sums[:, places + k * span] for k in range(-2, 3)], axis=0) / span
    level = (before + after) / 2
    lit = level > MIN_LIGHT * level.max()
    return np.divide(3 * (after - before) - (beyond - far), 2 * level, out=np.zeros_like(level), where=lit), lit
