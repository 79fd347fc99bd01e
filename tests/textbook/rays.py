"""Caustic by ray tracing, a cross-check of the wave optics with the same surface; never used for a picture.

The lenslets of the paper's diffuser are so weak (Fresnel number below one) that diffraction dominates: rays give bright
lines that do not exist. After a blur of 50 um the two correlate by 0.98 (OPTICS.md 2.7).
"""

import numpy as np

from device.config.head_file import OpticsSpec
from device.optics.diffuser import EMMETROPIA, Grid, Refraction, eye_wavefront_um, iris, surface
from device.values import Image


def ray_caustic(optics: OpticsSpec, grid: Grid, seed: int, refraction: Refraction = EMMETROPIA) -> Image:
    """Return the density of ray end points of one point on the axis: float32 (grid.pixels, grid.pixels), sum 1.

    Each sample x of the iris is a ray, weighted by the iris's transmission. It ends at x + z grad(path), with z the
    distance from diffuser to sensor and `path` the optical path difference of diffuser and eye, and is distributed over
    the four pixels around its end point.
    """
    path_um = surface(optics, grid, seed) + eye_wavefront_um(optics, grid, refraction)
    slope_rows, slope_cols = np.gradient(path_um.astype(np.float64), grid.dx_um)
    x_um = grid.x_um
    rows_um = x_um[:, None] + optics.diffuser_to_sensor_um * slope_rows
    cols_um = x_um[None, :] + optics.diffuser_to_sensor_um * slope_cols
    light = iris(optics, grid).astype(np.float64) ** 2
    lit = light > 0
    landed = _splat_bilinearly(rows_um[lit], cols_um[lit], light[lit], grid)
    return np.asarray(landed / landed.sum(), np.float32)


def _splat_bilinearly(rows_um: np.ndarray, cols_um: np.ndarray, light: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the light of all rays on the pixels, (n, n), each ray bilinearly over the four around its end point."""
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
        pixel = np.clip(row + step, 0, n - 1) * n + np.clip(col + side, 0, n - 1)
        total += np.bincount(pixel.astype(np.int64), share * light, n * n)
    return total.reshape(n, n)
