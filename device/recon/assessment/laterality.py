"""Laterality estimate: right or left eye, from the position of the optic disc; None if uncertain.

In a right eye, as seen from in front, upright and not mirrored, the disc is to the right of the macula, in a left eye
to the left. The disc is where a bright spot of its size and upright vessels coincide: exudates are bright without
vessels, arcades are vessels without brightness. The macula beside it must be dark. The same test runs on a reduced copy
of the picture and on its mirror image, so a mirrored picture gives exactly the other eye.
"""

from dataclasses import dataclass
from math import exp, log

import numpy as np
from scipy import ndimage

from device.values import Eye, Image, Mask

SAMPLES_PER_DEG = 4.0  # of the reduced copy, at least; a vein is 0.4 deg wide
MIN_PER_DEG = 3.0  # coarser pictures do not resolve vessels
COARSE_PER_DEG = 2.0  # for structures of the size of a disc or a macula
BESIDE_DEG = 4.0  # above and below the centre of the disc, where the vessels are outside it
FOVEA_DEG = (2.0, -15.0)  # from the disc of a right eye: down, right
ABOUT_DEG = 2.5  # tolerance of that position: anatomy, and tilt of the head
DISC_DEG = 5.0  # structures farther from the disc's centre are not part of it
MIN_OFF_DEG = 4.0  # with a disc nearer to the centre the picture is nerve-centred: no estimate
RIM_DEG = 0.8  # width of the ignored edge of the field
FAINT = 1e-6
RIGHT: Eye = "OD"
LEFT: Eye = "OS"
SURE = 0.9
# Logistic threshold and slope of each sign, from the pictures of tests/bench/sides.py.
PEAK, PEAK_STEEP = 0.2, 6.0
RIVAL, RIVAL_STEEP = 2.2, 5.0
MACULA, MACULA_STEEP = 0.06, 90.0


@dataclass(frozen=True)
class Laterality:
    """Laterality of a picture.

    Attributes
    ----------
    eye
        OD or OS; None if uncertain.
    confidence
        Confidence of the likelier eye, 0 to 1.
    disc
        (row, col) of its disc in the picture; None without an eye.
    """

    eye: Eye | None
    confidence: float
    disc: tuple[float, float] | None = None


@dataclass(frozen=True)
class Signs:
    """Evidence that a picture shows a right eye, at the best position of a disc to the right of the centre.

    `peak` is the disc's excess brightness times the vessel density there, `rival` the maximum elsewhere; `macula` is
    the log ratio of the surroundings to the expected position of the macula, None if that is outside the field. `at` is
    (row, col) in samples.
    """

    peak: float
    rival: float
    macula: float | None
    at: tuple[float, float]

    @property
    def confidence(self) -> float:
        """Confidence that the picture shows a right eye, 0 to 1: of the weakest sign.

        0 if `macula` is None or `peak` <= `rival`.
        """
        if self.macula is None or self.peak <= self.rival:
            return 0.0
        peak = max(self.peak, FAINT)
        rival = max(self.rival, FAINT)
        weakest = min(
            PEAK_STEEP * log(peak / PEAK),
            RIVAL_STEEP * log(peak / rival / RIVAL),
            MACULA_STEEP * (self.macula - MACULA),
        )
        return 1 / (1 + exp(-weakest))


def laterality(picture: Image, px_per_deg: float, field_deg: float) -> Laterality:
    """Return the laterality of a macula-centred picture; the field's centre is that of the picture.

    `picture` is linear, float32 (rows, cols), upright and not mirrored; values outside the field are ignored. `eye` is
    None if the confidence is below SURE, or (confidence 0) if the picture shows less than half the field's width, is
    too coarse or has values that are not finite.
    """
    narrow = min(picture.shape) < px_per_deg * field_deg / 2
    if narrow or px_per_deg < MIN_PER_DEG or not np.isfinite(picture).all():
        return Laterality(None, 0.0)
    n = max(1, int(px_per_deg / SAMPLES_PER_DEG))
    right, left = (signs(_reduced(seen, n), px_per_deg / n, field_deg) for seen in (picture, picture[:, ::-1]))
    found, eye = (right, RIGHT) if right.confidence > left.confidence else (left, LEFT)
    sure = round(found.confidence, 4)
    if sure < SURE:
        return Laterality(None, sure)
    row, col = (at * n + size % n // 2 + (n - 1) / 2 for at, size in zip(found.at, picture.shape, strict=True))
    return Laterality(eye, sure, (float(row), float(col if eye == RIGHT else picture.shape[1] - 1 - col)))


def signs(picture: Image, per_deg: float, field_deg: float) -> Signs:
    """Return the evidence for a right eye in a reduced picture of `per_deg` samples per degree."""
    down, right, away = _degrees(picture.shape, per_deg)
    field = (away < field_deg / 2 - RIM_DEG / 2).astype(np.float32)
    level = max(float(picture[field > 0].mean(dtype=np.float64)), FAINT)
    logs = np.clip(np.log(np.maximum(picture / np.float32(level), np.float32(0.05))), -1.5, 1.5) * field
    spot = 2 * max(1, round(0.35 * per_deg)) + 1
    logs = ndimage.grey_opening(logs, size=(spot, spot)) * field  # removes exudates: bright dots, dark between them
    vessels = _upright_vessels(logs, away < field_deg / 2 - 1.5 * RIM_DEG, per_deg)
    filled = ndimage.grey_closing(logs, size=(spot, spot)) * field  # removes vessels: narrower, and dark

    m = max(1, round(per_deg / COARSE_PER_DEG))
    weight = _reduced(field, m)
    per_deg = per_deg / m
    light = _flat(np.divide(_reduced(filled, m), weight.clip(FAINT), dtype=np.float32), weight, per_deg)
    around = _mean(light, weight, 4.0 * per_deg)
    disc = np.maximum(_mean(light, weight, 1.6 * per_deg) - around, 0) * _reduced(vessels, m)
    dark = around - _mean(light, weight, 1.5 * per_deg)
    down, right, away = _degrees(disc.shape, per_deg)
    allowed = away < field_deg / 2 - RIM_DEG
    row, col = np.unravel_index(np.argmax(np.where(allowed & (right > MIN_OFF_DEG), disc, -1)), disc.shape)
    y = down[row, 0]
    x = right[0, col]
    beyond = allowed & (np.hypot(down - y, right - x) > DISC_DEG)
    about = np.hypot(down - y - FOVEA_DEG[0], right - x - FOVEA_DEG[1]) < ABOUT_DEG
    about &= away < field_deg / 2 - 2 * RIM_DEG
    at = (row + 0.5) * m + picture.shape[0] % m // 2 - 0.5, (col + 0.5) * m + picture.shape[1] % m // 2 - 0.5
    macula = float(dark[about].max()) if about.any() else None
    return Signs(float(disc[row, col]), float(disc[beyond].max(initial=0.0)), macula, at)


def _degrees(shape: tuple[int, ...], per_deg: float) -> tuple[Image, Image, Image]:
    """Return the positions of the samples in degrees: down (rows, 1), right (1, cols), distance from the centre."""
    down, right = (((np.arange(size) - (size - 1) / 2) / per_deg).astype(np.float32) for size in shape)
    return down[:, None], right[None], np.hypot(down[:, None], right[None])


def _reduced(picture: Image, n: int) -> Image:
    """Return the means over n x n pixels, centred in the picture."""
    rows, cols = (size // n for size in picture.shape)
    top, left = (size % n // 2 for size in picture.shape)
    cut = picture[top : top + rows * n, left : left + cols * n]
    means: Image = cut.reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float32)
    return means


def _mean(image: Image, weight: Image, sigma: float) -> Image:
    """Return the Gaussian mean over the samples of the field, whose mask is `weight`; `sigma` is in samples."""
    weights = ndimage.gaussian_filter(weight, sigma, mode="constant").clip(0.02)
    mean: Image = ndimage.gaussian_filter(image * weight, sigma, mode="constant") / weights
    return mean


def _flat(logs: Image, weight: Image, per_deg: float) -> Image:
    """Return the log picture minus its Gaussian mean (sigma 5 degrees) over the field, clipped to +-0.8."""
    flat: Image = np.clip(logs - _mean(logs, weight, 5.0 * per_deg), -0.8, 0.8)
    return flat


def _upright_vessels(logs: Image, inside: Mask, per_deg: float) -> Image:
    """Return the density of upright dark lines above and below each position, as at a disc; 1 is the average.

    The position itself is left out: patches of bright spots are dark between them.
    """
    sigma = max(0.25 * per_deg, 1.0)
    down, across, both = (
        ndimage.gaussian_filter(logs, sigma, order=order, mode="constant") for order in ((2, 0), (0, 2), (1, 1))
    )
    bend = np.hypot((down - across) / 2, both)
    line = np.maximum((down + across) / 2 + bend, 0) * inside
    upright = line * (1 + (across - down) / np.maximum(2 * bend, FAINT)) / 2  # the square of the angle's cosine
    along = 1.5 * per_deg, 0.8 * per_deg
    weight = ndimage.gaussian_filter(inside.astype(np.float32), along, mode="constant", truncate=2.5)
    density = ndimage.gaussian_filter(upright, along, mode="constant", truncate=2.5) / np.maximum(weight, 0.05)
    usual = max(float(upright[inside].mean(dtype=np.float64)), FAINT)
    near = ndimage.maximum_filter(density, size=(1, 2 * round(2.0 * per_deg) + 1)) / usual
    far = round(BESIDE_DEG * per_deg)
    above = np.zeros_like(near)
    below = np.zeros_like(near)
    above[far:], below[:-far] = near[:-far], near[far:]
    vessels: Image = np.sqrt(above * below, dtype=np.float32)
    return vessels
