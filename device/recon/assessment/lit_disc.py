"""Lit disc of a frame: its diameter, found where the light of a wider picture ends; NUMERICS.md 8.5.

For files, whose field may be wrong by a factor of 2: a disc that is whole and centred, or none. The refraction has a
finder of its own (`estimation/refraction/lit_disc`), which needs the calibrated field, and fits a part of a displaced
disc. Neither serves both: that fit gave 35.4 to 59.6 degrees on a cropped sensor where this one gives 33.5 to 33.7 of
33.4, and this one finds no disc beside a lid, or 1.5 degrees off the axis.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.forward_model import tight_model
from device.recon.model.grid import Grid
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Preprocessor
from device.recon.solvers.tv import EvidenceWiener
from device.values import Calibration, Image

WIDER, LEAST_WIDER = 2.0, 1.2  # times the field: of the picture, within the sensor and at the least
FIELD_SAMPLES = 64  # across the field, at the least
SECTORS = 16
STEP_SAMPLES = 4  # on either side of the edge
AGREE_RATIO = 0.05  # of the median radius: the edge of a disc in a sector
MIN_AGREEING = 0.75  # of the sectors: given fields have 0.81 to 1, lids, flicker, dust and foreign PSFs up to 0.69
MIN_DROP, MAX_DROP = 0.35, 1.5  # of the light inside, over the edge: discs 0.38 to 1.05, a constant frame 3

Series = NDArray[np.float64]


def lit_disc_deg(calibration: Calibration, counts: Pixels, planner: Planner, index: int = 0) -> float | None:
    """Return the diameter of the lit disc of a frame in degrees; None where its light does not end in a disc.

    Parameters
    ----------
    calibration
        Calibration with a geometry and a field, which may be wrong by a factor of 2.
    counts
        Counts, (rows, cols).
    planner
        Planner of the FFTs.
    index
        Index of the PSF in the calibration.

    Returns
    -------
    float or None
        Diameter in degrees, to about half a sample of FIELD_SAMPLES.

    Raises
    ------
    FrameError
        Too many pixels are missing.
    """
    assert calibration.field_deg is not None
    assert calibration.geometry is not None
    shape = (counts.shape[0], counts.shape[1])
    given_px = field_radius_px(calibration)
    wider = min(WIDER, max(min(shape) / 2 / given_px, LEAST_WIDER))
    wide = replace(calibration, field_deg=calibration.field_deg * wider)
    n = max(1, int(2 * given_px // FIELD_SAMPLES))
    model = tight_model(wide, shape, n, planner, index)
    solver = EvidenceWiener(model, wide)
    picture = np.zeros(model.grid.shape, np.float32)
    solver.start(Preprocessor(wide, model.grid)(counts, None, DefectFinder(wide, shape, index)(counts)))
    solver.finish(picture)
    radius = disc_radius(_profiles(picture, model.grid))
    return None if radius is None else 2 * radius * n / calibration.geometry.px_per_deg


def _profiles(picture: Image, grid: Grid) -> Series:
    """Return the mean light of each ring of one sample in each sector, (SECTORS, rings)."""
    rings = int(grid.radius_samples)
    down, right = (np.arange(size) - middle for size, middle in zip(grid.shape, grid.centre, strict=True))
    radius = np.hypot(down[:, None], right)
    sector = ((np.arctan2(down[:, None], right) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    inside = radius < rings
    place = (sector * rings + radius.astype(np.int64))[inside]
    light = np.bincount(place, picture[inside], SECTORS * rings)
    area = np.bincount(place, minlength=SECTORS * rings)
    return np.asarray((light / np.maximum(area, 1)).reshape(SECTORS, rings), np.float64)


def disc_radius(profiles: Series) -> float | None:
    """Return the radius of a disc in rings, where its light drops; None unless MIN_AGREEING of the sectors agree.

    `profiles` is (sectors, rings), each with the light of the first ring in its centre.
    """
    sums = np.cumsum(np.pad(profiles, ((0, 0), (1, 0))), axis=1)
    means = (sums[:, STEP_SAMPLES:] - sums[:, :-STEP_SAMPLES]) / STEP_SAMPLES
    drops = means[:, :-STEP_SAMPLES] - means[:, STEP_SAMPLES:]
    edges = drops.argmax(axis=1) + STEP_SAMPLES
    middle = float(np.median(edges))
    agree = np.abs(edges - middle) <= AGREE_RATIO * middle
    light = float(np.median(profiles[:, : int(0.9 * middle)]))
    height = float(drops.max(axis=1)[agree].mean()) if agree.any() else 0.0
    if agree.mean() < MIN_AGREEING or not MIN_DROP * light <= height <= MAX_DROP * light:
        return None
    drop = drops[agree].mean(axis=0)
    at = int(drop.argmax())
    left, top, right = (float(drop[min(max(at + k, 0), len(drop) - 1)]) for k in (-1, 0, 1))
    curvature = left - 2 * top + right
    return at + STEP_SAMPLES + (0.5 * (left - right) / curvature if curvature < 0 else 0.0)
