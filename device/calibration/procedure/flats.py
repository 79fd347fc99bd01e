"""Flat-field analysis: gain by photon transfer, pixel response (PRNU), linearity and saturation."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from device.calibration.procedure.darks import Darks
from device.calibration.procedure.moments import Moments
from device.errors import CalibrationRefused
from device.values import Image, Mask

BLOCKS = 24  # per side, to which the shading is fitted
ORDER = 4  # of the polynomial that models the shading of a screen
MAX_SHADING = 0.4  # from the darkest to the brightest part of a screen; decision 0018 has what to expect
MAX_UNEVEN = 0.01  # residual of a block, in addition to 6 sigma of the pixels
MIN_SHARE = 0.02  # of the converter range: a darker flat means that the cap is on
MAX_BEND = 0.1  # at white
DEAD_PIXEL_RESPONSE = 0.5  # share of the mean response
MIN_SATURATED_PIXELS = 0.2  # share of pixels at the same count: half of a mosaic may be dark in one colour
SATURATED_SHARE = 0.95  # of the converter range; brighter pixels are clipped

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Flats:
    """Response of one sensor to uniform light.

    `white_dn` is the saturation count. `response` (rows, cols) is the relative response of each pixel (PRNU), 1 in the
    mean of its colour-mosaic site; `dead` (rows, cols) marks pixels below half; `nonlinearity` is the relative
    deviation at white, `bend_per_dn` per count; `shading` is the brightest over the darkest part of the screen itself.
    """

    gain_e_per_dn: float
    white_dn: float
    nonlinearity: float
    bend_per_dn: float
    shading: float
    response: Image
    dead: Mask


def measure_flats(levels: Sequence[Moments], bright: Moments, darks: Darks) -> Flats:
    """Return the sensor response from flats of one screen at several exposures and one saturated flat.

    Photon transfer: the temporal variance is signal / gain + read noise; its slope gives the gain (EMVA 1288, 6.6;
    OPTICS.md 3.8). With 8 frames of 270 x 480 pixels the error of the gain is 0.2 %. CalibrationRefused for unsuitable
    flats: fewer than three, dark, saturated, uneven or not linear.
    """
    if len(levels) < 3:
        raise CalibrationRefused(f"{len(levels)} levels do not make a line", "Take three flats or more.")
    good = ~darks.hot
    signals = [level.mean_dn - darks.at(level.exposure_s) for level in levels]
    white_dn = _saturation_dn(bright, max(levels, key=lambda level: level.exposure_s), good)
    for level, signal in zip(levels, signals, strict=True):
        _refuse_level(level, signal, good, white_dn)
    total: Image = np.sum([signal * level.count for level, signal in zip(levels, signals, strict=True)], axis=0)
    response, shading = flat_field_response(total, good)
    dead = (response < DEAD_PIXEL_RESPONSE) & good
    good &= ~dead
    times_s = np.array([level.exposure_s for level in levels])
    means = np.array([float(signal[good].mean(dtype=np.float64)) for signal in signals])
    per_s, bend_per_dn = line_through_zero(times_s, means)
    variances = np.array([float(level.variance_dn2[good].mean(dtype=np.float64)) for level in levels])
    gain = photon_transfer(per_s * times_s, variances, bend_per_dn, darks)
    bend = bend_per_dn * (white_dn - darks.black_dn)
    if abs(bend) > MAX_BEND:
        raise CalibrationRefused(
            f"the counts do not grow with the exposure: they bend by {bend:+.1%} at white (at most {MAX_BEND:.0%})",
            "Use a screen that does not flicker, and switch off the camera's own tone curve.",
        )
    return Flats(gain, white_dn, bend, bend_per_dn, shading, response, dead)


def linearised(light_dn: Image, bend_per_dn: float) -> Image:
    """Return s for counts above dark `light_dn` = s (1 + b s), b = `bend_per_dn`, as a series to the third order."""
    bent = np.float32(bend_per_dn) * light_dn
    return np.asarray(light_dn * (1 - bent * (1 - 2 * bent)))


def line_through_zero(times_s: Floats, means_dn: Floats) -> tuple[float, float]:
    """Return (rate, b) of the fit mean = s (1 + b s) with s = rate x time; rate in DN per second, b per DN."""
    slope, per_s = np.polyfit(times_s, means_dn / times_s, 1, w=np.sqrt(times_s))
    return float(per_s), float(slope / per_s**2)


def photon_transfer(straight_dn: Floats, variances_dn2: Floats, bend_per_dn: float, darks: Darks) -> float:
    """Return the gain, electrons per count, from the variance at each linearised level `straight_dn`.

    A bend b multiplies noise by 1 + 2 b s; quantisation adds 1/12. CalibrationRefused if the noise does not grow.
    """
    stretched = (1 + 2 * bend_per_dn * straight_dn) ** 2
    photons_dn2 = (variances_dn2 - 1 / 12) / stretched - darks.read_noise_dn**2
    weight = 1 / np.maximum(photons_dn2, 1e-3) ** 2  # the error of a variance is proportional to the variance
    slope = float((weight * photons_dn2 * straight_dn).sum() / (weight * straight_dn**2).sum())
    if slope <= 0:
        raise CalibrationRefused(
            f"the noise does not grow with the light (slope {slope:.3g} DN per DN)",
            "The camera smooths or packs its frames. Switch off its own processing.",
        )
    return 1 / slope


def flat_field_response(light: Image, good: Mask) -> tuple[Image, float]:
    """Return each pixel over the smooth shading of the screen, 1 in the mean of each mosaic site; and that shading.

    The shading is the brightest over the darkest block. Raises CalibrationRefused if it is too large, or if no
    fourth-order polynomial fits: an object is in the beam.
    """
    blocks, seen = _block_means(light, good)
    basis = _basis(*(_block_centres(size) for size in light.shape))
    weight = np.sqrt(seen.ravel())
    solved = np.linalg.lstsq(basis * weight[:, None], blocks.ravel() * weight, rcond=None)
    found = np.asarray(solved[0], np.float64)
    smooth = (basis @ found).reshape(blocks.shape)
    darkest = float(blocks.min())
    brightest = float(blocks.max())
    remedy = "Lay the camera, without iris and diffuser, on the clean screen, light it evenly, then start again."
    if darkest < (1 - MAX_SHADING) * brightest:
        fall = 1 - darkest / brightest
        message = f"one part of the flat is {fall:.0%} darker than another (at most {MAX_SHADING:.0%})"
        raise CalibrationRefused(message, remedy)
    uneven = np.abs(blocks / smooth - 1)
    size = np.sqrt(light.size / blocks.size)
    pixels = float(np.std(light[good] / light[good].mean(dtype=np.float64), dtype=np.float64))
    allowed = MAX_UNEVEN + 6 * pixels / size
    if uneven.max() > allowed:
        message = f"one part of the flat differs by {uneven.max():.1%} from its surroundings (at most {allowed:.1%})"
        raise CalibrationRefused(message, remedy)
    even: Image = (light / _evaluate_polynomial(found, light.shape)).astype(np.float32)
    return _normalised_per_site(even, good), brightest / darkest


def _normalised_per_site(response: Image, good: Mask) -> Image:
    """Return the response over its mean per mosaic site, 1 at bad pixels; the colour filter is not equalised."""
    response = np.where(good, response, np.float32(np.nan)).astype(np.float32)
    for row in (0, 1):
        for col in (0, 1):
            response[row::2, col::2] /= np.float32(np.nanmean(response[row::2, col::2], dtype=np.float64))
    return np.nan_to_num(response, copy=False, nan=1.0)


def _block_means(light: Image, good: Mask) -> tuple[Floats, Floats]:
    """Return the mean of the good pixels of each block, and their count."""
    rows, cols = (_block_starts(size) for size in light.shape)
    summed, seen = (
        np.add.reduceat(np.add.reduceat(part.astype(np.float64), rows, 0), cols, 1) for part in (light * good, good)
    )
    return summed / np.maximum(seen, 1), seen


def _block_starts(size: int) -> NDArray[np.intp]:
    """Return the first index of each block; blocks have even length, so that each holds all mosaic sites equally."""
    blocks = min(BLOCKS, size // 4)
    return np.arange(blocks) * 2 * (size // (2 * blocks))


def _block_centres(size: int) -> Floats:
    """Return the centre of each block on a side that runs from -1 to 1."""
    starts = _block_starts(size)
    ends = np.append(starts[1:], size)
    centres: Floats = (starts + ends) / size - 1
    return centres


def _basis(rows: Floats, cols: Floats) -> Floats:
    """Return the monomials of two variables up to total degree ORDER at the block centres, (blocks, terms)."""
    powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    return np.stack([np.outer(rows**i, cols**j).ravel() for i, j in powers], axis=1)


def _evaluate_polynomial(found: Floats, shape: tuple[int, ...]) -> Image:
    """Return the polynomial with the coefficients `found` at every pixel of `shape`, (rows, cols)."""
    rows, cols = (np.linspace(-1, 1, 2 * n + 1)[1::2] for n in shape)
    powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    down = np.zeros((shape[0], ORDER + 1))
    for value, (i, j) in zip(found, powers, strict=True):
        down[:, j] += value * rows**i
    return (down @ np.stack([cols**j for j in range(ORDER + 1)])).astype(np.float32)


def _saturation_dn(bright: Moments, longest: Moments, good: Mask) -> float:
    """Return the saturation count, DN, from a saturated flat; CalibrationRefused if it is not saturated."""
    counts = bright.mean_dn[good]
    most = float(np.percentile(counts, 99.5))
    full = float(np.mean(counts > most - 1.0))
    if bright.exposure_s < 1.1 * longest.exposure_s or full < MIN_SATURATED_PIXELS:
        raise CalibrationRefused(
            f"the brightest flat is not saturated: only {full:.1%} of the pixels are at {most:.0f} DN",
            "Use a brighter screen.",
        )
    return float(ceil(most - 0.5))


def _refuse_level(level: Moments, signal: Image, good: Mask, white_dn: float) -> None:
    """Raise CalibrationRefused if a flat is too dark or saturated."""
    mean_dn = float(np.median(signal[good]))
    highest_dn = float(np.percentile(level.highest[good], 99))
    if mean_dn < MIN_SHARE * white_dn:
        raise CalibrationRefused(
            f"the flat of {level.exposure_s:.3g} s is dark: {mean_dn:.0f} DN (at least {MIN_SHARE * white_dn:.0f})",
            "Take the cap off and switch the screen on, then start again.",
        )
    if highest_dn >= SATURATED_SHARE * white_dn:
        raise CalibrationRefused(
            f"the flat of {level.exposure_s:.3g} s is saturated: {highest_dn:.0f} of {white_dn:.0f} DN",
            "Dim the screen.",
        )
