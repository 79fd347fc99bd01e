"""The caustic by rays, as a cross-check of the waves: another physics of the same surface. Never for a picture.

At the paper's diffuser the lenslets are so weak that light bends round them (Fresnel number below one), so rays draw
bright lines that do not exist; after a blur of 50 um the two agree to 0.98 (optics.md 2.3).
"""

import numpy as np

from device.optics.diffuser import EMMETROPIA, Grid, Refraction, eye_wavefront_um, iris, surface
from device.spec import OpticsSpec
from device.values import Image


def ray_caustic(optics: OpticsSpec, grid: Grid, seed: int, refraction: Refraction = EMMETROPIA) -> Image:
    """Where the rays of one point on the axis land: float32 (grid.pixels, grid.pixels), sum 1.

    A ray leaves the iris against the slope of the path and lands at x - z grad(path): what is retarded lags. Each
    sample is a ray, shared between the four pixels around its landing place.
    """
    path_um = surface(optics, grid, seed) + eye_wavefront_um(optics, grid, refraction)
    slope_rows, slope_cols = np.gradient(path_um.astype(np.float64), grid.dx_um)
    x_um = grid.x_um
    rows_um = x_um[:, None] + optics.diffuser_to_sensor_um * slope_rows
    cols_um = x_um[None, :] + optics.diffuser_to_sensor_um * slope_cols
    light = iris(optics, grid).astype(np.float64) ** 2
    lit = light > 0
    landed = _shared(rows_um[lit], cols_um[lit], light[lit], grid)
    return np.asarray(landed / landed.sum(), np.float32)


def _shared(rows_um: np.ndarray, cols_um: np.ndarray, light: np.ndarray, grid: Grid) -> np.ndarray:
    """Light onto pixels, each ray's in proportion to its nearness to the four around it."""
    n = grid.pixels
    total = np.zeros(n * n)
    row, col = (np.floor(at / grid.pitch_um + n // 2) for at in (rows_um, cols_um))
    down, across = rows_um / grid.pitch_um + n // 2 - row, cols_um / grid.pitch_um + n // 2 - col
    for step, side, share in (
        (0, 0, (1 - down) * (1 - across)),
        (0, 1, (1 - down) * across),
        (1, 0, down * (1 - across)),
        (1, 1, down * across),
    ):
        there = np.clip(row + step, 0, n - 1) * n + np.clip(col + side, 0, n - 1)
        total += np.bincount(there.astype(np.int64), share * light, n * n)
    return total.reshape(n, n)
