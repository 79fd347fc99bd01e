"""Dark-frame analysis: black level, read noise, dark current, fixed-pattern noise (DSNU) and hot pixels.

Read noise may be far below one count (0.18 DN on the paper's sensor). Quantisation then changes the variance, so a
normal distribution, rounded to whole counts, is fitted to the measured mean and variance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np
import scipy  # whose module optimize is imported at its first use: it takes 22 MB, and only a calibration needs it
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from device.calibration.procedure.moments import Moments
from device.errors import CalibrationRefused
from device.values import Image, Mask

HOT_SIGMAS = 6.0  # of pattern and noise: a normal pixel exceeds them once in 5e8
MAX_HOT = 0.02  # share of pixels; a larger share is light, not dark current
MAX_DARK_SHARE = 0.05  # of the converter: a dark frame that rises by more than this saw light
MAX_SHADING_DN = 0.5  # between parts of a dark frame, beside 6 sigma of its noise
MIN_THIRD_COUNTS = 10.0  # occurrences of a third count; fewer carry no information on sigma
MIN_SIGMA_DN = 0.05  # with less noise than this only one count occurs
DARKEN_REMEDY = "Put the cap on, turn the lamp off, shade the room, then start again."
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(41)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Darks:
    """Dark response of one sensor; `black_dn` is the level at zero exposure.

    `read_noise_dn` belongs to the exposure `shortest_s`, which contains a little dark current. `pattern_dn` is the
    spread of the pixels (DSNU), `dark_dn_per_s` the dark current. `map_dn` (rows, cols) is the mean dark frame at
    `map_s`; `hot` (rows, cols) marks hot pixels; `warm_c` is the temperature of the head, NaN without a thermometer.
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
        """Return the dark frame of `exposure_s`, (rows, cols), DN: `map_dn` plus mean dark current x extra time."""
        dark: Image = self.map_dn + np.float32(self.dark_dn_per_s * (exposure_s - self.map_s))
        return dark


def measure_darks(exposures: Sequence[Moments], map_s: float, white_dn: float) -> Darks:
    """Return the dark response from dark frames at two exposures or more, one of them at `map_s`.

    Errors with 16 frames of 270 x 480 pixels: black level 0.01 DN, read noise 3 %. If only two counts occur in all
    frames, read noise is an upper bound. CalibrationRefused if light reaches the sensor. OPTICS.md 3.8.
    """
    if len(exposures) < 2:
        raise CalibrationRefused("darks at one exposure only say nothing about warmth", "Take two exposures or more.")
    for exposure in exposures:
        _refuse_brightness(exposure, white_dn)
    shortest = min(exposures, key=lambda exposure: exposure.exposure_s)
    mapped = min(exposures, key=lambda exposure: abs(exposure.exposure_s - map_s))
    hot = hot_pixels(exposures)
    levels = [_fit_level(exposure, hot) for exposure in exposures]
    times_s = np.array([exposure.exposure_s for exposure in exposures])
    dark_dn_per_s, black_dn = np.polyfit(times_s, [level for level, _ in levels], 1)
    _refuse_light(exposures, hot, float(dark_dn_per_s * np.ptp(times_s)), white_dn)
    total_dn = levels[exposures.index(shortest)][1]
    read_dn = read_noise_dn(levels[exposures.index(shortest)][0], total_dn, _temporal(shortest, hot))
    mean_dn = mapped.mean_dn
    level_dn = black_dn + dark_dn_per_s * mapped.exposure_s  # of the fit: rounding biases the mean of counts
    mean_dn += np.float32(level_dn - float(mean_dn[~hot].mean(dtype=np.float64)))
    pattern_dn = sqrt(max(total_dn**2 - read_dn**2, 0.0))
    rate_dn_per_s = float(dark_dn_per_s)
    shortest_s = shortest.exposure_s
    return Darks(float(black_dn), shortest_s, read_dn, pattern_dn, rate_dn_per_s, mapped.exposure_s, mean_dn, hot)


def hot_pixels(exposures: Sequence[Moments]) -> Mask:
    """Return the mask (rows, cols) of pixels over 6 sigma plus one count from the median of any exposure's mean."""
    hot = np.zeros(exposures[0].shape, np.bool_)
    for exposure in exposures:
        low, middle, high = np.percentile(exposure.mean_dn, (15.87, 50.0, 84.13))
        hot |= np.abs(exposure.mean_dn - np.float32(middle)) > 1.0 + HOT_SIGMAS * (high - low) / 2
    return hot


def quantised_moments(mean_dn: float, sigma_dn: float) -> tuple[float, float]:
    """Return mean (DN) and variance (DN squared) of a normal distribution that is rounded to whole counts."""
    first = np.floor(mean_dn) - np.ceil(8 * sigma_dn) - 2
    edges = first + np.arange(2 * np.ceil(8 * sigma_dn) + 6) - 0.5
    shares = np.diff(ndtr((edges - mean_dn) / sigma_dn))
    counts = edges[:-1] + 0.5
    mean = float(shares @ counts)
    return mean, float(shares @ (counts - mean) ** 2)


def fit_normal(mean_dn: float, variance_dn2: float) -> tuple[float, float]:
    """Return mean and sigma, DN, of the normal distribution whose rounded counts have this mean and variance."""

    def miss(distribution: Floats) -> list[float]:
        mean, variance = quantised_moments(float(distribution[0]), float(distribution[1]))
        return [mean - mean_dn, np.sqrt(variance) - np.sqrt(variance_dn2)]

    below = mean_dn - np.floor(mean_dn)
    starts = [(np.floor(mean_dn) + lean * below + (1 - lean) * 0.5, 0.2) for lean in (1.0, 0.5, 0.2)]
    starts.append((mean_dn, sqrt(max(variance_dn2 - 1 / 12, 0.04))))
    box = ([mean_dn - 1, MIN_SIGMA_DN], [mean_dn + 1, 2 * sqrt(variance_dn2) + 1])
    tried = [scipy.optimize.least_squares(miss, start, bounds=box, xtol=1e-12, ftol=1e-14) for start in starts]
    found = min(tried, key=lambda fit: float(fit.cost))
    return float(found.x[0]), float(found.x[1])


def has_two_counts_only(mean_dn: float, variance_dn2: float, samples: int) -> bool:
    """Return whether (nearly) only two neighbouring counts occur: one known share cannot fix both mean and sigma."""
    above = mean_dn % 1
    return (variance_dn2 - above * (1 - above)) * samples < MIN_THIRD_COUNTS


def widest_normal(mean_dn: float, samples: int) -> tuple[float, float]:
    """Return mean and sigma, DN, of the widest normal distribution that yields a third count at most ten times."""
    above = float(np.clip(mean_dn % 1, 1 / samples, 1 - 1 / samples))

    def distribution(sigma_dn: float) -> tuple[float, float]:
        return float(np.floor(mean_dn) + 0.5 + sigma_dn * ndtri(above)), sigma_dn

    def beyond(sigma_dn: float) -> float:
        mean, variance = quantised_moments(*distribution(sigma_dn))
        return variance - (mean % 1) * (1 - mean % 1) - MIN_THIRD_COUNTS / samples

    return distribution(float(scipy.optimize.brentq(beyond, MIN_SIGMA_DN / 2, 1.0, xtol=1e-4)))


def read_noise_dn(mean_dn: float, total_dn: float, temporal_dn2: float) -> float:
    """Return the temporal noise, DN: `total_dn` without the fixed spread of the pixels (DSNU).

    `mean_dn` is the level; `temporal_dn2` is the variance of rounded counts, averaged over pixels whose offsets are
    normally distributed. `total_dn` is returned if the two cannot be separated.
    """

    def miss(read_dn: float) -> float:
        spread_dn = sqrt(max(total_dn**2 - read_dn**2, 0.0))
        seen = [quantised_moments(mean_dn + spread_dn * node, read_dn)[1] for node in NODES]
        return float(WEIGHTS @ seen / WEIGHTS.sum()) - temporal_dn2

    if miss(total_dn) <= 0:  # the fixed spread cannot be separated from the noise
        return total_dn
    if miss(MIN_SIGMA_DN / 2) >= 0:
        return MIN_SIGMA_DN
    return float(scipy.optimize.brentq(miss, MIN_SIGMA_DN / 2, total_dn, xtol=1e-6))


def _fit_level(exposure: Moments, hot: Mask) -> tuple[float, float]:
    """Return level and total spread of the good pixels, DN: temporal noise and fixed pattern; CalibrationRefused."""
    good = ~hot
    means = exposure.mean_dn[good].astype(np.float64)
    mean_dn = float(means.mean())
    within = _temporal(exposure, hot) * (exposure.count - 1) / exposure.count
    variance_dn2 = float(means.var()) + within
    if variance_dn2 == 0:
        raise CalibrationRefused(
            f"every dark frame is the same, {mean_dn:.0f} DN in every pixel: no sensor is without noise",
            "The camera does not give raw counts, or its black level is cut off. Check its driver.",
        )
    samples = int(good.sum()) * exposure.count
    return (
        widest_normal(mean_dn, samples)
        if has_two_counts_only(mean_dn, variance_dn2, samples)
        else fit_normal(mean_dn, variance_dn2)
    )


def _temporal(exposure: Moments, hot: Mask) -> float:
    """Return the mean temporal variance of the good pixels, DN squared."""
    return float(exposure.variance_dn2[~hot].mean(dtype=np.float64))


def _refuse_brightness(exposure: Moments, white_dn: float) -> None:
    """Raise CalibrationRefused if the median pixel is above half of the converter range."""
    if (middle_dn := float(np.median(exposure.mean_dn))) > white_dn / 2:
        raise CalibrationRefused(f"the dark frames are bright: {middle_dn:.0f} of {white_dn:.0f} DN", DARKEN_REMEDY)


def _refuse_light(exposures: Sequence[Moments], hot: Mask, rise_dn: float, white_dn: float) -> None:
    """Raise CalibrationRefused for too many hot pixels, too large a rise with the exposure, or a brighter part."""
    longest = max(exposures, key=lambda exposure: exposure.exposure_s)
    remedy = DARKEN_REMEDY
    if hot.mean() > MAX_HOT:
        raise CalibrationRefused(f"{hot.mean():.1%} of the pixels shine in the dark (at most {MAX_HOT:.0%})", remedy)
    if rise_dn > MAX_DARK_SHARE * white_dn:
        message = (
            f"the dark frames rise by {rise_dn:.0f} DN with the exposure (at most {MAX_DARK_SHARE * white_dn:.0f})"
        )
        raise CalibrationRefused(message, remedy)
    mean = np.where(hot, np.float32(np.median(longest.mean_dn)), longest.mean_dn)
    parts = np.array([[part.mean() for part in np.array_split(row, 8, 1)] for row in np.array_split(mean, 8, 0)])
    shading_dn = float(np.ptp(parts))
    allowed_dn = MAX_SHADING_DN + 12 * float(mean.std()) * 8 / sqrt(mean.size)
    if shading_dn > allowed_dn:
        message = f"one part of the dark frames is {shading_dn:.2f} DN brighter than another (at most {allowed_dn:.2f})"
        raise CalibrationRefused(message, remedy)
