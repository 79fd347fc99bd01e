"""What an even screen says: electrons per count (photon transfer), response of each pixel, linearity, saturation."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from device.calibration.darks import Darks
from device.calibration.moments import Moments
from device.errors import CalibrationRefused
from device.values import Image, Mask

BLOCKS = 24  # per side: what shading is fitted to
ORDER = 4  # of the polynomial that a screen's shading is
MOST_SHADING = 0.4  # from the darkest to the brightest part of a screen
MOST_UNEVEN = 0.01  # of a block beside the smooth shading, beyond 6 sigma of the pixels
LEAST_SHARE = 0.02  # of the converter: a flat below this is a cap
MOST_BEND = 0.1  # at white
DEAD = 0.5  # of its neighbours' response
LEAST_FULL = 0.2  # share of pixels that end together: half of a mosaic's may see little of one colour
FULL = 0.95  # of the converter: what is brighter is cut

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Flats:
    """The response of one sensor to even light.

    `response` (rows, cols) is each pixel's, 1 in the mean of its site of a colour mosaic; `dead` (rows, cols) marks
    pixels below half; `nonlinearity` is the relative bend at white, `bend_per_dn` that of one count; `shading` is the
    screen's own, brightest over darkest.
    """

    gain_e_per_dn: float
    white_dn: float
    nonlinearity: float
    bend_per_dn: float
    shading: float
    response: Image
    dead: Mask


def measured_flats(levels: Sequence[Moments], bright: Moments, darks: Darks) -> Flats:
    """From flats of one screen at several exposures, and one too bright for the sensor, to its response.

    Photon transfer: the variance from frame to frame is signal / gain + read noise; its slope tells the gain (EMVA
    1288, 6.6; optics.md 3.9). With 8 frames of 270 x 480 pixels its error is 0.2 %.
    """
    if len(levels) < 3:
        raise CalibrationRefused(f"{len(levels)} levels do not make a line", "Take three flats or more.")
    good = ~darks.hot
    signals = [one.mean_dn - darks.at(one.exposure_s) for one in levels]
    white_dn = _white_dn(bright, max(levels, key=lambda one: one.exposure_s), good)
    for one, signal in zip(levels, signals, strict=True):
        _refuse_level(one, signal, good, white_dn)
    total: Image = np.sum([signal * one.count for one, signal in zip(levels, signals, strict=True)], axis=0)
    response, shading = evened(total, good)
    dead = (response < DEAD) & good
    good &= ~dead
    times_s = np.array([one.exposure_s for one in levels])
    means = np.array([float(signal[good].mean(dtype=np.float64)) for signal in signals])
    per_s, bend_per_dn = line_through_zero(times_s, means)
    variances = np.array([float(one.variance_dn2[good].mean(dtype=np.float64)) for one in levels])
    gain = photon_transfer(per_s * times_s, variances, bend_per_dn, darks)
    bend = bend_per_dn * (white_dn - darks.black_dn)
    if abs(bend) > MOST_BEND:
        raise CalibrationRefused(
            f"the counts do not grow with the exposure: they bend by {bend:+.1%} at white (at most {MOST_BEND:.0%})",
            "Use a screen that does not flicker, and switch off the camera's own tone curve.",
        )
    return Flats(gain, white_dn, bend, bend_per_dn, shading, response, dead)


def straight(light_dn: Image, bend_per_dn: float) -> Image:
    """Counts above dark as a sensor without a bend would have counted: the s of s (1 + b s), to the third order."""
    bent = np.float32(bend_per_dn) * light_dn
    return np.asarray(light_dn * (1 - bent * (1 - 2 * bent)))


def line_through_zero(times_s: Floats, means_dn: Floats) -> tuple[float, float]:
    """DN per second and the bend b of mean = s (1 + b s), s = DN per second x time; b per DN."""
    slope, per_s = np.polyfit(times_s, means_dn / times_s, 1, w=np.sqrt(times_s))
    return float(per_s), float(slope / per_s**2)


def photon_transfer(straight_dn: Floats, variances_dn2: Floats, bend_per_dn: float, darks: Darks) -> float:
    """Electrons per count from the variance at each level of `straight_dn` (what a straight sensor would have counted).

    A bend b multiplies noise by 1 + 2 b s; whole counts add 1/12.
    """
    stretched = (1 + 2 * bend_per_dn * straight_dn) ** 2
    photons_dn2 = (variances_dn2 - 1 / 12) / stretched - darks.read_noise_dn**2
    weight = 1 / np.maximum(photons_dn2, 1e-3) ** 2  # a variance is as wrong as it is large
    slope = float((weight * photons_dn2 * straight_dn).sum() / (weight * straight_dn**2).sum())
    if slope <= 0:
        raise CalibrationRefused(
            f"the noise does not grow with the light (slope {slope:.3g} DN per DN)",
            "The camera smooths or packs its frames. Switch off its own processing.",
        )
    return 1 / slope


def evened(light: Image, good: Mask) -> tuple[Image, float]:
    """Each pixel over the screen's own smooth shading, 1 in the mean of each mosaic site; and that shading.

    Refuses what no polynomial of fourth order describes: something in the beam.
    """
    blocks, seen = _blocks(light, good)
    basis = _basis(*(_centres(size) for size in light.shape))
    weight = np.sqrt(seen.ravel())
    solved = np.linalg.lstsq(basis * weight[:, None], blocks.ravel() * weight, rcond=None)
    found = np.asarray(solved[0], np.float64)
    smooth = (basis @ found).reshape(blocks.shape)
    darkest, brightest = float(blocks.min()), float(blocks.max())
    remedy = "Take everything out of the beam, clean screen and diffuser, light the screen evenly, then start again."
    if darkest < (1 - MOST_SHADING) * brightest:
        fall = 1 - darkest / brightest
        said = f"one part of the flat is {fall:.0%} darker than another (at most {MOST_SHADING:.0%})"
        raise CalibrationRefused(said, remedy)
    uneven = np.abs(blocks / smooth - 1)
    size = np.sqrt(light.size / blocks.size)
    pixels = float(np.std(light[good] / light[good].mean(dtype=np.float64), dtype=np.float64))
    allowed = MOST_UNEVEN + 6 * pixels / size
    if uneven.max() > allowed:
        said = f"one part of the flat differs by {uneven.max():.1%} from its surroundings (at most {allowed:.1%})"
        raise CalibrationRefused(said, remedy)
    even: Image = (light / _everywhere(found, light.shape)).astype(np.float32)
    return _per_site(even, good), brightest / darkest


def _per_site(response: Image, good: Mask) -> Image:
    """What a mosaic's filter keeps away must not be made up for: it would be noise."""
    response = np.where(good, response, np.float32(np.nan)).astype(np.float32)
    for row in (0, 1):
        for col in (0, 1):
            response[row::2, col::2] /= np.float32(np.nanmean(response[row::2, col::2], dtype=np.float64))
    return np.nan_to_num(response, copy=False, nan=1.0)


def _blocks(light: Image, good: Mask) -> tuple[Floats, Floats]:
    """The mean of the good pixels of each block, and how many these are."""
    rows, cols = (_starts(size) for size in light.shape)
    summed, seen = (
        np.add.reduceat(np.add.reduceat(part.astype(np.float64), rows, 0), cols, 1) for part in (light * good, good)
    )
    return summed / np.maximum(seen, 1), seen


def _starts(size: int) -> NDArray[np.intp]:
    """Where blocks begin: of even length, so that a mosaic's sites are in each alike."""
    blocks = min(BLOCKS, size // 4)
    return np.arange(blocks) * 2 * (size // (2 * blocks))


def _centres(size: int) -> Floats:
    """The middle of each block on a side that goes from -1 to 1."""
    starts = _starts(size)
    ends = np.append(starts[1:], size)
    centres: Floats = (starts + ends) / size - 1
    return centres


def _basis(rows: Floats, cols: Floats) -> Floats:
    powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    return np.stack([np.outer(rows**i, cols**j).ravel() for i, j in powers], axis=1)


def _everywhere(found: Floats, shape: tuple[int, ...]) -> Image:
    """The polynomial on every pixel, row by row of blocks."""
    rows, cols = (np.linspace(-1, 1, 2 * n + 1)[1::2] for n in shape)
    powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    down = np.zeros((shape[0], ORDER + 1))
    for value, (i, j) in zip(found, powers, strict=True):
        down[:, j] += value * rows**i
    return (down @ np.stack([cols**j for j in range(ORDER + 1)])).astype(np.float32)


def _white_dn(bright: Moments, longest: Moments, good: Mask) -> float:
    """The count at which nothing more is added: of a screen that is too bright."""
    counts = bright.mean_dn[good]
    most = float(np.percentile(counts, 99.5))
    full = float(np.mean(counts > most - 1.0))
    if bright.exposure_s < 1.1 * longest.exposure_s or full < LEAST_FULL:
        raise CalibrationRefused(
            f"the brightest flat is not saturated: only {full:.1%} of the pixels are at {most:.0f} DN",
            "Use a brighter screen.",
        )
    return float(ceil(most - 0.5))


def _refuse_level(one: Moments, signal: Image, good: Mask, white_dn: float) -> None:
    mean_dn, highest_dn = float(np.median(signal[good])), float(np.percentile(one.highest[good], 99))
    if mean_dn < LEAST_SHARE * white_dn:
        raise CalibrationRefused(
            f"the flat of {one.exposure_s:.3g} s is dark: {mean_dn:.0f} DN (at least {LEAST_SHARE * white_dn:.0f})",
            "Take the cap off and switch the screen on, then start again.",
        )
    if highest_dn >= FULL * white_dn:
        raise CalibrationRefused(
            f"the flat of {one.exposure_s:.3g} s is saturated: {highest_dn:.0f} of {white_dn:.0f} DN", "Dim the screen."
        )
