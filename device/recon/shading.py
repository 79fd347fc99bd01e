"""The low orders of a picture: an evenly bright field, its shading, and stray light, fitted through the blur.

What is smooth over the whole field is what a cropped sensor determines worst by iteration and best by a small least
squares: 45 Zernike polynomials on the field's disc, blurred once at planning, and a constant for light that never
passed the diffuser. Without it a small sensor needs 160 rounds for what 10 then do.
"""

from math import factorial, isfinite

import numpy as np
from numpy.typing import NDArray

from device.recon.kernels import Box
from device.recon.model import Model
from device.values import Image

DEGREE = 8
BLOCK = 4  # the fit looks at means of 4 x 4 samples: the modes are smooth
RIDGE = 1e-4
STRAY_RIDGE = 1e-2  # where the whole sensor is lit a constant is nearly a mode: doubt it until the frame insists


class Shading:
    """The modes of one model, and the matrix that turns a frame into their coefficients.

    Without a known field there is one mode: evenly bright everywhere.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.box: Box = model.box
        modes = list(_modes(model)) if isfinite(model.grid.radius_samples) else [model.mask]
        seen = [_blocks(model.blur(mode)[model.grid.slices]).ravel() for mode in modes]
        top, bottom, left, right = self.box
        self._modes = np.stack([mode[top:bottom, left:right].ravel() for mode in modes])
        if isfinite(model.grid.radius_samples):
            seen.append(np.full_like(seen[0], float(seen[0].max())))  # stray light, at home in the same scale
        ridge = np.full(len(seen), RIDGE)
        ridge[len(modes) :] = STRAY_RIDGE
        self._fit = self._solver(np.stack(seen), ridge)
        self._stray_scale = float(seen[0].max())

    @staticmethod
    def _solver(seen: Image, ridge: NDArray[np.float64]) -> Image:
        """Weighted ridge regression: the weights are those of shot noise under an even field."""
        weights = 1 / (np.maximum(seen[0], 0) / seen[0].max() + 0.03)
        normal = (seen * weights) @ seen.T
        return np.asarray(np.linalg.solve(normal + np.diag(ridge * np.diag(normal)), seen * weights), np.float32)

    def fit(self, y: Image, out: Image) -> tuple[float, float]:
        """Write the smooth picture into `out` (the grid); return the field's mean level and the stray light, in DN."""
        coefficients = self._fit @ _blocks(y).ravel()
        top, bottom, left, right = self.box
        out[:] = 0
        smooth = coefficients[: len(self._modes)] @ self._modes
        out[top:bottom, left:right] = smooth.reshape(bottom - top, right - left)
        stray = float(coefficients[-1]) * self._stray_scale if len(coefficients) > len(self._modes) else 0.0
        return float(coefficients[0]), stray


def _blocks(image: Image) -> Image:
    if min(image.shape) < BLOCK:
        return np.ascontiguousarray(image)
    rows, cols = (size // BLOCK for size in image.shape)
    cut = image[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK)
    means: Image = cut.mean(axis=(1, 3))
    return means


def _modes(model: Model) -> "list[Image]":
    """Zernike polynomials up to DEGREE on the field's disc, the even field first."""
    rows, cols = model.grid.shape
    v = (np.arange(rows)[:, None] - model.grid.centre[0]) / model.grid.radius_samples
    u = (np.arange(cols)[None] - model.grid.centre[1]) / model.grid.radius_samples
    radius, angle = np.minimum(np.hypot(u, v), 1), np.arctan2(v, u)
    return [
        (model.mask * _radial(n, abs(m), radius) * (np.cos(m * angle) if m >= 0 else np.sin(-m * angle))).astype(
            np.float32
        )
        for n in range(DEGREE + 1)
        for m in range(-n, n + 1, 2)
    ]


def _radial(n: int, m: int, radius: NDArray[np.float64]) -> NDArray[np.float64]:
    total = np.zeros_like(radius)
    for k in range((n - m) // 2 + 1):
        sign, top = (-1) ** k, factorial(n - k)
        total += (
            sign
            * top
            / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
            * radius ** (n - 2 * k)
        )
    return total
