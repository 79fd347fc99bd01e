"""Field of view: radius and bounding box of the lit field on the sensor, in pixels, or the field found in a picture."""

import numpy as np
from scipy import ndimage

from device.recon.model.grid import Grid, Pair
from device.values import Calibration, Image

LIT_SHARE = 0.3  # of the level that a tenth of the picture exceeds: the field is brighter
LIT_SIGMA_PX = 6.0  # smoothing, so that vessels make no holes


def field_box(calibration: Calibration, shape: Pair) -> tuple[slice, slice]:
    """Return the row and column slices of the sensor around the illuminated disc; the whole sensor if unknown."""
    return Grid.periodic(shape, 1, field_radius_px(calibration)).shown


def field_radius_px(calibration: Calibration) -> float:
    """Return the radius of the illuminated disc in sensor pixels; infinite if field or geometry are unknown."""
    if calibration.field_deg is None or calibration.geometry is None:
        return float("inf")
    return calibration.field_deg * calibration.geometry.px_per_deg / 2


def lit_field(picture: Image, grid: Grid) -> Image:
    """Return the lit field in a picture whose field is unknown, on its grid, 0 or 1: its largest bright area.

    Bright is LIT_SHARE of the level that a tenth of the window exceeds; holes, such as a dark macula, are filled.
    """
    level = ndimage.gaussian_filter(picture, LIT_SIGMA_PX / grid.n)
    bright = np.zeros(grid.shape, bool)
    bright[grid.slices] = (level > LIT_SHARE * np.quantile(level[grid.slices], 0.9))[grid.slices]
    areas, count = ndimage.label(bright)
    if count == 0:
        return np.ones(grid.shape, np.float32)
    largest = 1 + int(np.argmax(ndimage.sum_labels(bright, areas, range(1, count + 1))))
    return np.asarray(ndimage.binary_fill_holes(areas == largest), np.float32)
