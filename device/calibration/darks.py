"""What a capped sensor says: black level, read noise, dark current, fixed pattern, hot pixels.

Read noise may be far below one count (0.18 DN on the paper's sensor). Counts are then whole numbers of a normal law,
and their variance is not that of the law; so the law itself is fitted to them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares
from scipy.special import ndtr, ndtri

from device.calibration.moments import Moments
from device.errors import CalibrationRefused
from device.values import Image, Mask

HOT_SIGMAS = 6.0  # of the fixed pattern and the noise: a normal pixel is beyond once in 5e8
MOST_HOT = 0.02  # share of pixels; more is light, not heat
MOST_DARK_SHARE = 0.05  # of the converter: a dark frame that rises by more than this saw light
MOST_SHADING_DN = 0.5  # between parts of a dark frame, beside 6 sigma of its noise
SEEN = 10.0  # times: what is rarer tells nothing
UNDECIDED_DN = 0.05  # a noise below this never leaves its count
NO_LIGHT = "Put the cap on, turn the lamp off, shade the room, then start again."
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(41)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Darks:
    """The dark of one sensor: `black_dn` without exposure, noise and pixel spread, warmth, and where it is hot.

    `read_noise_dn` is that of the exposure `shortest_s`, in which a little of the warmth may have arrived.
    `map_dn` (rows, cols) is the mean dark frame at `map_s`; `hot` (rows, cols) marks pixels that are far from the rest;
    `warm_c` is how warm the head was, NaN if it cannot say.
    """

    black_dn: float
    shortest_s: float
    read_noise_dn: float
    pattern_dn: float
    dark_dn_per_s: float
    map_s: float
    map_dn: Image
    hot: Mask
    warm_c: float = nan

    def at(self, exposure_s: float) -> Image:
        """The dark frame of another exposure, (rows, cols), DN."""
        dark: Image = self.map_dn + np.float32(self.dark_dn_per_s * (exposure_s - self.map_s))
        return dark


def measured_darks(exposures: Sequence[Moments], map_s: float, white_dn: float) -> Darks:
    """From darks at two exposures or more, one of them at `map_s`, to what a sensor says without light.

    Errors with 16 frames of 270 x 480 pixels: black level 0.01 DN, read noise 3 %. Where all frames together show two
    counts only, read noise is the most that it can be. optics.md 3.9.
    """
    if len(exposures) < 2:
        raise CalibrationRefused("darks at one exposure only say nothing about warmth", "Take two exposures or more.")
    for one in exposures:
        _refuse_brightness(one, white_dn)
    shortest = min(exposures, key=lambda one: one.exposure_s)
    mapped = min(exposures, key=lambda one: abs(one.exposure_s - map_s))
    hot = hot_pixels(exposures)
    levels = [_law(one, hot) for one in exposures]
    times_s = np.array([one.exposure_s for one in exposures])
    dark_dn_per_s, black_dn = np.polyfit(times_s, [level for level, _ in levels], 1)
    _refuse_light(exposures, hot, float(dark_dn_per_s * np.ptp(times_s)), white_dn)
    total_dn = levels[exposures.index(shortest)][1]
    read_dn = read_noise_dn(levels[exposures.index(shortest)][0], total_dn, _temporal(shortest, hot))
    mean_dn = mapped.mean_dn
    level_dn = black_dn + dark_dn_per_s * mapped.exposure_s  # the law's: whole counts lean to the nearest
    mean_dn += np.float32(level_dn - float(mean_dn[~hot].mean(dtype=np.float64)))
    pattern_dn = sqrt(max(total_dn**2 - read_dn**2, 0.0))
    warmth_dn_per_s, shortest_s = float(dark_dn_per_s), shortest.exposure_s
    return Darks(float(black_dn), shortest_s, read_dn, pattern_dn, warmth_dn_per_s, mapped.exposure_s, mean_dn, hot)


def hot_pixels(exposures: Sequence[Moments]) -> Mask:
    """Pixels far from the rest in any exposure: 6 sigma of the middle 68 %, and a count; (rows, cols)."""
    hot = np.zeros(exposures[0].shape, np.bool_)
    for one in exposures:
        low, middle, high = np.percentile(one.mean_dn, (15.87, 50.0, 84.13))
        hot |= np.abs(one.mean_dn - np.float32(middle)) > 1.0 + HOT_SIGMAS * (high - low) / 2
    return hot


def whole_counts(mean_dn: float, sigma_dn: float) -> tuple[float, float]:
    """Mean and variance of a normal law that is rounded to whole counts; DN, DN squared."""
    first = np.floor(mean_dn) - np.ceil(8 * sigma_dn) - 2
    edges = first + np.arange(2 * np.ceil(8 * sigma_dn) + 6) - 0.5
    shares = np.diff(ndtr((edges - mean_dn) / sigma_dn))
    counts = edges[:-1] + 0.5
    mean = float(shares @ counts)
    return mean, float(shares @ (counts - mean) ** 2)


def fitted_law(mean_dn: float, variance_dn2: float) -> tuple[float, float]:
    """The normal law whose whole counts have this mean and variance: its own mean and sigma, DN."""

    def miss(law: Floats) -> list[float]:
        mean, variance = whole_counts(float(law[0]), float(law[1]))
        return [mean - mean_dn, np.sqrt(variance) - np.sqrt(variance_dn2)]

    below = mean_dn - np.floor(mean_dn)
    starts = [(np.floor(mean_dn) + lean * below + (1 - lean) * 0.5, 0.2) for lean in (1.0, 0.5, 0.2)]
    starts.append((mean_dn, sqrt(max(variance_dn2 - 1 / 12, 0.04))))
    box = ([mean_dn - 1, UNDECIDED_DN], [mean_dn + 1, 2 * sqrt(variance_dn2) + 1])
    tried = [least_squares(miss, start, bounds=box, xtol=1e-12, ftol=1e-14) for start in starts]
    found = min(tried, key=lambda one: float(one.cost))
    return float(found.x[0]), float(found.x[1])


def undecided(mean_dn: float, variance_dn2: float, samples: int) -> bool:
    """Whether two neighbouring counts are all that is seen: they tell one number, and a law has two."""
    above = mean_dn % 1
    return (variance_dn2 - above * (1 - above)) * samples < SEEN


def most_law(mean_dn: float, samples: int) -> tuple[float, float]:
    """The widest normal law that shows a third count not more than ten times: its mean and sigma, DN."""
    above = float(np.clip(mean_dn % 1, 1 / samples, 1 - 1 / samples))

    def law(sigma_dn: float) -> tuple[float, float]:
        return float(np.floor(mean_dn) + 0.5 + sigma_dn * ndtri(above)), sigma_dn

    def beyond(sigma_dn: float) -> float:
        mean, variance = whole_counts(*law(sigma_dn))
        return variance - (mean % 1) * (1 - mean % 1) - SEEN / samples

    return law(float(brentq(beyond, UNDECIDED_DN / 2, 1.0, xtol=1e-4)))


def read_noise_dn(mean_dn: float, total_dn: float, temporal_dn2: float) -> float:
    """The noise from frame to frame, DN: `total_dn` less the pixels' fixed spread, whose share the whole counts tell.

    `temporal_dn2` is the variance of whole counts in the mean over pixels whose zeros are spread normally.
    """

    def miss(read_dn: float) -> float:
        spread_dn = sqrt(max(total_dn**2 - read_dn**2, 0.0))
        seen = [whole_counts(mean_dn + spread_dn * node, read_dn)[1] for node in NODES]
        return float(WEIGHTS @ seen / WEIGHTS.sum()) - temporal_dn2

    if miss(total_dn) <= 0:  # no fixed spread that could be told from noise
        return total_dn
    return float(brentq(miss, UNDECIDED_DN / 2, total_dn, xtol=1e-6)) if miss(UNDECIDED_DN / 2) < 0 else UNDECIDED_DN


def _law(one: Moments, hot: Mask) -> tuple[float, float]:
    """Level and total spread of the good pixels, DN: noise and fixed pattern together."""
    good = ~hot
    means = one.mean_dn[good].astype(np.float64)
    mean_dn = float(means.mean())
    within = _temporal(one, hot) * (one.count - 1) / one.count
    variance_dn2 = float(means.var()) + within
    if variance_dn2 == 0:
        raise CalibrationRefused(
            f"every dark frame is the same, {mean_dn:.0f} DN in every pixel: no sensor is without noise",
            "The camera does not give raw counts, or its black level is cut off. Check its driver.",
        )
    samples = int(good.sum()) * one.count
    return (
        most_law(mean_dn, samples) if undecided(mean_dn, variance_dn2, samples) else fitted_law(mean_dn, variance_dn2)
    )


def _temporal(one: Moments, hot: Mask) -> float:
    return float(one.variance_dn2[~hot].mean(dtype=np.float64))


def _refuse_brightness(one: Moments, white_dn: float) -> None:
    """Half of the pixels beyond the middle of the converter: no black level is there."""
    if (middle_dn := float(np.median(one.mean_dn))) > white_dn / 2:
        raise CalibrationRefused(f"the dark frames are bright: {middle_dn:.0f} of {white_dn:.0f} DN", NO_LIGHT)


def _refuse_light(exposures: Sequence[Moments], hot: Mask, rise_dn: float, white_dn: float) -> None:
    """Darks that grow like a picture, or are brighter here than there, have seen light."""
    longest = max(exposures, key=lambda one: one.exposure_s)
    remedy = NO_LIGHT
    if hot.mean() > MOST_HOT:
        raise CalibrationRefused(f"{hot.mean():.1%} of the pixels shine in the dark (at most {MOST_HOT:.0%})", remedy)
    if rise_dn > MOST_DARK_SHARE * white_dn:
        said = f"the dark frames rise by {rise_dn:.0f} DN with the exposure (at most {MOST_DARK_SHARE * white_dn:.0f})"
        raise CalibrationRefused(said, remedy)
    mean = np.where(hot, np.float32(np.median(longest.mean_dn)), longest.mean_dn)
    parts = np.array([[part.mean() for part in np.array_split(row, 8, 1)] for row in np.array_split(mean, 8, 0)])
    shading_dn = float(np.ptp(parts))
    allowed_dn = MOST_SHADING_DN + 12 * float(mean.std()) * 8 / sqrt(mean.size)
    if shading_dn > allowed_dn:
        said = f"one part of the dark frames is {shading_dn:.2f} DN brighter than another (at most {allowed_dn:.2f})"
        raise CalibrationRefused(said, remedy)
