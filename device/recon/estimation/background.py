"""Background: smooth light on the sensor that is no image, beside the constant of the shading fit; NUMERICS.md 3.8.

Stray light and reflections change slowly over the sensor. Outside the lit disc such light is all that a sensor sees, so
it shows there whether a constant explains it. If not, a polynomial of the sensor's coordinates is fitted together with
the shading of the disc. A sensor that the disc fills has no such place: shading of the retina and of stray light are
then indistinguishable, and only the constant is fitted.
"""

from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.shading import RIDGE, Shading, block_means
from device.recon.model.preprocessing import Linear
from device.values import Image

DEGREE = 6  # of the polynomial; a Gaussian in a corner, of a quarter of the sensor's width, needs it
MIN_UNLIT = 0.05  # share of the sensor outside the lit disc
UNLIT = 0.02  # of the brightest place: the disc's edge
GUARD_PX = 16  # outside of it: the edge of the caustic moves by 0.054 mm in an eye of 10 dpt
UNEVEN = (
    0.7  # of what a constant leaves of the unlit blocks: clean frames up to 0.65, a gradient of 1 % of the mean 0.87
)
ENOUGH_RMS = 0.0003  # of the mean light: what a polynomial may leave of the unlit blocks
MIN_RMS = 0.0012  # of the mean light, that of a gradient of 0.4 %, which changes no picture; clean frames up to 0.0008
RIDGES = np.array([1e-4, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2])  # by degree: a high one may peak under the disc


class SensorPolynomial:
    """Products of Legendre polynomials up to a total degree on the blocks (n x n samples) of a window, constant first.

    `on_blocks` is float32 (polynomials, blocks), `ridges` the ridge of each.
    """

    def __init__(self, blocks_shape: tuple[int, int], n: int, degree: int = DEGREE) -> None:
        self.n, self._blocks_shape, self._degree = n, blocks_shape, degree
        rows, cols = (legendre.legvander(np.linspace(-1, 1, size), degree).T for size in blocks_shape)
        self._orders = [(total - k, k) for total in range(degree + 1) for k in range(total + 1)]
        products = [np.outer(rows[i], cols[k]).ravel() for i, k in self._orders]
        self.on_blocks: Image = np.stack(products).astype(np.float32)
        self.ridges = RIDGES[[i + k for i, k in self._orders]]

    def on_samples(self, coefficients: NDArray[np.float64], window: tuple[int, int]) -> Image:
        """Return the sum of the polynomials times these coefficients on all samples of the window, float32."""
        table = np.zeros((self._degree + 1, self._degree + 1))
        for (i, k), value in zip(self._orders, coefficients, strict=True):
            table[i, k] = value
        rows, cols = (
            legendre.legvander(((np.arange(size) + 0.5) / self.n - 0.5) / (count - 1) * 2 - 1, self._degree)
            for size, count in zip(window, self._blocks_shape, strict=True)
        )
        return np.asarray(rows @ table @ cols.T, np.float32)


class Background:
    """Search for an uneven background in the frames of one model, whose smooth part `shading` fits.

    `highest` is the polynomial of degree 6.
    """

    def __init__(self, shading: Shading, pixels_per_sample: int) -> None:
        self._shading = shading
        blurred = shading.blurred
        flat = blurred.modes[0].reshape(blurred.shape)
        guard = -(-GUARD_PX // (blurred.n * pixels_per_sample))
        lit = ndimage.binary_dilation(flat >= UNLIT * flat.max(), np.ones((3, 3), np.bool_), iterations=guard)
        self._unlit = np.flatnonzero(~lit)
        self.highest = SensorPolynomial(blurred.shape, blurred.n)
        functions = self.highest.on_blocks
        self._basis: Image | None = None
        if len(self._unlit) >= max(MIN_UNLIT * flat.size, 2 * len(functions)):
            self._basis = np.linalg.qr(functions[:, self._unlit].T)[0].T[1:].copy()  # by degree, without the constant

    def polynomial(self, frame: Linear) -> SensorPolynomial | None:
        """Return the polynomial of least degree that explains the light outside the disc; None if a constant does."""
        if self._basis is None:
            return None
        dark = self._shading.unexplained(frame, self._unlit)
        dark -= dark.mean()
        energy = float(dark @ dark)
        explained = np.cumsum((self._basis @ dark) ** 2, dtype=np.float64)
        if explained[-1] < max(UNEVEN * energy, dark.size * (MIN_RMS * frame.mean_dn) ** 2):
            return None
        enough = max(2 * (energy - float(explained[-1])), dark.size * (ENOUGH_RMS * frame.mean_dn) ** 2)
        by_degree = [energy - float(explained[(k + 1) * (k + 2) // 2 - 2]) for k in range(1, DEGREE + 1)]
        degree = 1 + next(k for k, left in enumerate(by_degree) if left <= enough)
        blurred = self._shading.blurred
        return SensorPolynomial(blurred.shape, blurred.n, degree)

    def fit(self, frame: Linear) -> Image | None:
        """Return the background in DN, float32 (rows, cols) of the window; None if a constant explains the frame."""
        polynomial = self.polynomial(frame)
        if polynomial is None:
            return None
        blurred = self._shading.blurred
        return joint_background(frame, blurred.modes, blurred.weights, polynomial, polynomial.ridges)


def joint_background(
    frame: Linear, seen: Image, weights: Image, polynomial: SensorPolynomial, ridges: NDArray[np.float64] | float
) -> Image:
    """Return the polynomial that fits a frame together with the blurred modes `seen`, in DN on the frame's samples.

    `seen` is (modes, blocks), the even field first, `weights` (blocks,), `ridges` those of the polynomials;
    weighted ridge regression of block means.
    """
    share, means = block_means(frame, polynomial.n)
    brightest = float(seen[0].max())
    functions = np.concatenate([seen, polynomial.on_blocks * np.float32(brightest)])
    weighted = functions * (weights * share)
    normal = np.asarray(weighted @ functions.T, np.float64)
    ridges = np.concatenate([np.full(len(seen), RIDGE), np.broadcast_to(ridges, len(polynomial.on_blocks))])
    found = np.linalg.solve(normal + np.diag(ridges * np.diag(normal)), np.asarray(weighted @ means, np.float64))
    return polynomial.on_samples(np.asarray(found[len(seen) :] * brightest, np.float64), frame.y.shape)


def without(frame: Linear, background: Image | None) -> Linear:
    """Return the frame without this background; its mean, by which noise is estimated, stays that of all light."""
    return frame if background is None else replace(frame, y=frame.y - background)
