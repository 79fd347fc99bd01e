"""Lesions of known place and size on a drawn retina, for the bench of what a reader sees (`lesions.py`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, cos, hypot, pi, sin

import numpy as np
from scipy.special import erfc

from device.values import Image, Mask

EDGE_SHARE = 1 / 6  # sigma of the blurred edge over the width: a small lesion is less sharp in um than a large one
SUBPIXELS = 5
MIN_APART_UM = 450.0  # between the edges of two lesions' lengths, so that no filter sees two of them
MAX_TRIALS = 100_000


@dataclass(frozen=True)
class Kind:
    """Kind of lesion: a blurred disc, or with `length_um` a blurred straight vessel.

    `contrast` is the Weber contrast of its middle against the retina around it in green, negative for a dark one;
    `count` is how many of them an eye has.
    """

    name: str
    width_um: float
    contrast: float
    count: int
    length_um: float = 0.0

    @property
    def reach_um(self) -> float:
        """Distance within which a detection is a match: one diameter, of a vessel half of its length."""
        return max(self.width_um, self.length_um / 2)


SPOTS = (
    Kind("microaneurysm 60 um", 60.0, -0.2, 12),
    Kind("microaneurysm 90 um", 90.0, -0.2, 12),
    Kind("microaneurysm 125 um", 125.0, -0.2, 12),
    Kind("haemorrhage 250 um", 250.0, -0.2, 4),
    Kind("exudate 90 um", 90.0, 0.2, 8),
)
VESSELS = tuple(Kind(f"vessel {width:g} um", width, -0.2, 5, 500.0) for width in (40.0, 80.0, 120.0))


@dataclass(frozen=True)
class Lesion:
    """A lesion at (row, col) in pixels; `turn_rad` turns a vessel from the direction of the rows' pixels."""

    kind: Kind
    row: float
    col: float
    turn_rad: float = 0.0


def profile(kind: Kind, um_per_px: float, offset_px: tuple[float, float] = (0.0, 0.0), turn_rad: float = 0.0) -> Image:
    """Return the shape of a lesion, about 0 to 1, in a square window with an odd number of pixels.

    Its middle is `offset_px` (rows, cols) from the central pixel; a pixel has the mean of SUBPIXELS^2 places.
    """
    half = ceil((max(kind.width_um, kind.length_um) / 2 + 4 * EDGE_SHARE * kind.width_um) / um_per_px) + 1
    size = 2 * half + 1
    steps = (np.arange(size * SUBPIXELS) + 0.5) / SUBPIXELS - 0.5 - half
    down, right = (steps[:, None] - offset_px[0]) * um_per_px, (steps[None] - offset_px[1]) * um_per_px
    along, across = (cos(turn_rad) * right + sin(turn_rad) * down, cos(turn_rad) * down - sin(turn_rad) * right)
    beyond = np.maximum(np.abs(along) - max(kind.length_um - kind.width_um, 0) / 2, 0)
    outside_um = np.hypot(beyond, across) - kind.width_um / 2
    fine = erfc(outside_um / (2**0.5 * EDGE_SHARE * kind.width_um)) / 2
    return np.asarray(fine.reshape(size, SUBPIXELS, size, SUBPIXELS).mean(axis=(1, 3)), np.float32)


def with_lesions(plane: Image, lesions: Sequence[Lesion], um_per_px: float) -> Image:
    """Return a plane of reflectance (rows, cols) with lesions, each inside of it by its own window."""
    drawn = plane.copy()
    for lesion in lesions:
        row, col = round(lesion.row), round(lesion.col)
        shape = profile(lesion.kind, um_per_px, (lesion.row - row, lesion.col - col), lesion.turn_rad)
        half = shape.shape[0] // 2
        window = drawn[row - half : row + half + 1, col - half : col + half + 1]
        window *= 1 + np.float32(lesion.kind.contrast) * shape
    return drawn


def scattered(kinds: Sequence[Kind], allowed: Mask, um_per_px: float, rng: np.random.Generator) -> list[Lesion]:
    """Return lesions at random places of the mask, none near another; RuntimeError if there is too little room."""
    places = np.argwhere(allowed)
    lesions: list[Lesion] = []
    wanted = [kind for kind in kinds for _ in range(kind.count)]
    for _ in range(MAX_TRIALS):
        if len(lesions) == len(wanted):
            return lesions
        kind = wanted[len(lesions)]
        row, col = places[rng.integers(len(places))] + rng.uniform(-0.5, 0.5, 2)
        apart = (
            hypot(row - other.row, col - other.col) * um_per_px - (kind.length_um + other.kind.length_um) / 2
            for other in lesions
        )
        if all(distance_um > MIN_APART_UM for distance_um in apart):
            lesions.append(Lesion(kind, float(row), float(col), float(rng.uniform(0, pi)) if kind.length_um else 0.0))
    raise RuntimeError(f"no room for {len(wanted)} lesions")
