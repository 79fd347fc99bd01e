"""Spots: parts of a frame that no object explains, such as dust on the sensor and reflexes; NUMERICS.md 3.10.

Dust on the sensor shades pixels and a reflex lights them, with an edge that is sharper than the PSF. No object
explains that, so it stays in the residual of the picture, in connected samples.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from device.recon.model.grid import Grid
from device.values import Image, Mask

NEAR_SAMPLES = 3  # side of the square over which the residual is averaged
OUTLYING_SD = 6.0  # robust standard deviations of such a mean; clean frames have no MIN_SAMPLES connected beyond
MIN_SAMPLES = 12  # connected, of a spot
SCALE_STEP = 3  # every third row and column gives the robust standard deviation
BORDER_SAMPLES = 3  # left out around a spot: its edge


class Spots(NamedTuple):
    """Samples of the window that are left out, (rows, cols); whether they lose light in all, as behind dust; and
    the middle of the largest spot, (row, col) in samples.
    """

    samples: Mask
    are_dark: bool
    largest: tuple[int, int]


def find_spots(left_sd: Image, good: Mask) -> Spots | None:
    """Return the spots in a residual in units of the noise, both (rows, cols); None if there are none.

    `good` is False for missing samples.
    """
    near = ndimage.uniform_filter(np.where(good, left_sd, np.float32(0)), NEAR_SAMPLES)
    size = np.abs(near)
    some = (slice(None, None, SCALE_STEP),) * 2
    scale = float(np.median(size[some][good[some]])) / 0.6745 if good[some].any() else 0.0
    outlying = (size > OUTLYING_SD * scale) & good
    if np.count_nonzero(outlying) < MIN_SAMPLES:
        return None
    areas, count = ndimage.label(outlying)
    numbers = np.arange(1, count + 1)
    sizes = ndimage.sum_labels(good, areas, numbers)
    large = np.isin(areas, numbers[sizes >= MIN_SAMPLES])
    if not large.any():
        return None
    row, col = ndimage.center_of_mass(areas == numbers[np.argmax(sizes)])
    samples = np.asarray(ndimage.binary_dilation(large, iterations=BORDER_SAMPLES), np.bool_)
    return Spots(samples, bool(near[large].sum() < 0), (round(row), round(col)))


def on_sensor(samples: Mask, grid: Grid) -> Mask:
    """Return the pixels of the grid's sensor that belong to these samples of its window."""
    pixels = np.zeros(grid.sensor, np.bool_)
    block = np.repeat(np.repeat(samples, grid.n, 0), grid.n, 1)
    top, left = grid.first_px
    pixels[top : top + block.shape[0], left : left + block.shape[1]] = block
    return pixels
