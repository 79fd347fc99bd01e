"""Which eye a picture shows, told from where its optic disc lies; nothing is said where that is not sure.

A right eye as seen from in front, upright and not mirrored, has its disc to the right of its macula, a left eye to the
left. The disc is where a bright spot of its size and upright vessels meet: exudates are bright and have none, arcades
are vessels and not bright. The macula beside it must be dark. All is asked of a small copy, once as a right eye and
once of its mirror image, so that the mirrored picture gets the other answer, exactly.
"""

from dataclasses import dataclass
from math import exp, log

import numpy as np
from scipy import ndimage

from device.values import Eye, Image, Mask

SAMPLES_PER_DEG = 4.0  # of the small copy, at least; a vein is 0.4 deg wide
LEAST_PER_DEG = 3.0  # coarser pictures show no vessels
COARSE_PER_DEG = 2.0  # for what is as large as a disc or a macula
BESIDE_DEG = 4.0  # above and below a disc's middle, where its vessels have left it
FOVEA_DEG = (2.0, -15.0)  # from the disc of a right eye: down, right
ABOUT_DEG = 2.5  # how far from there the macula may be: eyes differ, and heads are held aslant
DISC_DEG = 5.0  # what is farther from the disc's middle is another thing
LEAST_OFF_DEG = 4.0  # a disc nearer to the middle belongs to a picture of the nerve, which does not tell
RIM_DEG = 0.8  # the outermost of the field is not asked
FAINT = 1e-6
RIGHT: Eye = "OD"
LEFT: Eye = "OS"
SURE = 0.9
# Where each sign is as likely to mislead as not, and how fast that changes; by the pictures of tests/bench/sides.py.
PEAK, PEAK_STEEP = 0.2, 6.0
RIVAL, RIVAL_STEEP = 2.2, 5.0
MACULA, MACULA_STEEP = 0.06, 90.0


@dataclass(frozen=True)
class Laterality:
    """Which eye a picture seems to be of, None where that is not sure.

    `confidence` is that in the likelier eye, 0 to 1; `disc` is its disc's (row, col) in it, None without an eye.
    """

    eye: Eye | None
    confidence: float
    disc: tuple[float, float] | None = None


@dataclass(frozen=True)
class Signs:
    """How much a picture looks like a right eye: the best place of a disc right of the middle.

    `peak` is disc times vessels there, `rival` the best anywhere else; `macula` how much darker it is where the macula
    should be than around, as a ratio's logarithm, None if that is outside the field. `at` is (row, col), samples.
    """

    peak: float
    rival: float
    macula: float | None
    at: tuple[float, float]

    @property
    def confidence(self) -> float:
        """How sure it is that this is a right eye, 0 to 1: as weak as the weakest sign."""
        if self.macula is None or self.peak <= self.rival:
            return 0.0
        peak, rival = max(self.peak, FAINT), max(self.rival, FAINT)
        weakest = min(
            PEAK_STEEP * log(peak / PEAK), RIVAL_STEEP * log(peak / rival / RIVAL),
            MACULA_STEEP * (self.macula - MACULA),
        )  # fmt: skip
        return 1 / (1 + exp(-weakest))


def laterality(picture: Image, px_per_deg: float, field_deg: float) -> Laterality:
    """Which eye a macula-centred picture shows; the field's middle is the picture's.

    `picture` is linear, float32 (rows, cols), upright and not mirrored, zero or anything outside the field.
    """
    narrow = min(picture.shape) < px_per_deg * field_deg / 2
    if narrow or px_per_deg < LEAST_PER_DEG or not np.isfinite(picture).all():
        return Laterality(None, 0.0)
    n = max(1, int(px_per_deg / SAMPLES_PER_DEG))
    right, left = (signs(_small(seen, n), px_per_deg / n, field_deg) for seen in (picture, picture[:, ::-1]))
    found, eye = (right, RIGHT) if right.confidence > left.confidence else (left, LEFT)
    sure = round(found.confidence, 4)
    if sure < SURE:
        return Laterality(None, sure)
    row, col = (at * n + size % n // 2 + (n - 1) / 2 for at, size in zip(found.at, picture.shape, strict=True))
    return Laterality(eye, sure, (float(row), float(col if eye == RIGHT else picture.shape[1] - 1 - col)))


def signs(picture: Image, per_deg: float, field_deg: float) -> Signs:
    """What speaks for a right eye in a small picture of `per_deg` samples per degree; `at` is in its samples."""
    down, right, away = _degrees(picture.shape, per_deg)
    field = (away < field_deg / 2 - RIM_DEG / 2).astype(np.float32)
    level = max(float(picture[field > 0].mean(dtype=np.float64)), FAINT)
    logs = np.clip(np.log(np.maximum(picture / np.float32(level), np.float32(0.05))), -1.5, 1.5) * field
    spot = 2 * max(1, round(0.35 * per_deg)) + 1
    logs = ndimage.grey_opening(logs, size=(spot, spot)) * field  # exudates are bright dots, dark between them
    vessels = _upright_vessels(logs, away < field_deg / 2 - 1.5 * RIM_DEG, per_deg)
    filled = ndimage.grey_closing(logs, size=(spot, spot)) * field  # vessels are narrower, and dark

    m = max(1, round(per_deg / COARSE_PER_DEG))
    weight, per_deg = _small(field, m), per_deg / m
    light = _flat(np.divide(_small(filled, m), weight.clip(FAINT), dtype=np.float32), weight, per_deg)
    around = _mean(light, weight, 4.0 * per_deg)
    disc = np.maximum(_mean(light, weight, 1.6 * per_deg) - around, 0) * _small(vessels, m)
    dark = around - _mean(light, weight, 1.5 * per_deg)
    down, right, away = _degrees(disc.shape, per_deg)
    asked = away < field_deg / 2 - RIM_DEG
    row, col = np.unravel_index(np.argmax(np.where(asked & (right > LEAST_OFF_DEG), disc, -1)), disc.shape)
    y, x = down[row, 0], right[0, col]
    beyond = asked & (np.hypot(down - y, right - x) > DISC_DEG)
    about = np.hypot(down - y - FOVEA_DEG[0], right - x - FOVEA_DEG[1]) < ABOUT_DEG
    about &= away < field_deg / 2 - 2 * RIM_DEG
    at = (row + 0.5) * m + picture.shape[0] % m // 2 - 0.5, (col + 0.5) * m + picture.shape[1] % m // 2 - 0.5
    macula = float(dark[about].max()) if about.any() else None
    return Signs(float(disc[row, col]), float(disc[beyond].max(initial=0.0)), macula, at)


def _degrees(shape: tuple[int, ...], per_deg: float) -> tuple[Image, Image, Image]:
    """Where samples are: degrees down (rows, 1), right (1, cols) and away from the middle."""
    down, right = (((np.arange(size) - (size - 1) / 2) / per_deg).astype(np.float32) for size in shape)
    return down[:, None], right[None], np.hypot(down[:, None], right[None])


def _small(picture: Image, n: int) -> Image:
    """Means over n x n pixels around the picture's middle."""
    rows, cols = (size // n for size in picture.shape)
    top, left = (size % n // 2 for size in picture.shape)
    cut = picture[top : top + rows * n, left : left + cols * n]
    means: Image = cut.reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float32)
    return means


def _mean(image: Image, weight: Image, sigma: float) -> Image:
    """Gaussian mean over what is in the field."""
    weights = ndimage.gaussian_filter(weight, sigma, mode="constant").clip(0.02)
    mean: Image = ndimage.gaussian_filter(image * weight, sigma, mode="constant") / weights
    return mean


def _flat(logs: Image, weight: Image, per_deg: float) -> Image:
    """The logarithm of the picture without its shading."""
    flat: Image = np.clip(logs - _mean(logs, weight, 5.0 * per_deg), -0.8, 0.8)
    return flat


def _upright_vessels(logs: Image, inside: Mask, per_deg: float) -> Image:
    """How many dark lines run up and down above and below a place, as out of a disc; 1 is as many as everywhere.

    In the place itself they are not asked for: what shines in patches is dark between them.
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
    above, below = np.zeros_like(near), np.zeros_like(near)
    above[far:], below[:-far] = near[:-far], near[far:]
    vessels: Image = np.sqrt(above * below, dtype=np.float32)
    return vessels
