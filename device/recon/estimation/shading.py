"""Shading: least-squares fit of the smooth part of the object (mean level, shading) and of stray light.

On a cropped sensor an iterative solver converges slowly in the low spatial frequencies; a small least-squares fit
determines them directly: 45 Zernike polynomials on the field's disc, blurred once per PSF, and a constant for light
that did not pass the diffuser. Without this fit a small sensor needs 160 solver iterations, with it 10.
"""

from collections.abc import Iterator
from math import factorial, isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.recon.model.forward_model import Model
from device.recon.model.kernels import Box
from device.recon.model.preprocessing import MIN_GOOD, Linear
from device.values import Image

DEGREE = 8
BLOCK = 4  # the fit uses means of 4 x 4 samples: the modes are smooth
RIDGE = 1e-4
STRAY_RIDGE = 1e-2  # stronger: on a fully lit sensor the constant is nearly collinear with a mode


class BlurredModes(NamedTuple):
    """Blurred shading modes as means over blocks of n x n samples, (modes, blocks) float32, the even field first.

    `weights` is that of each block under shot noise of an even field, (blocks,); `shape` counts the blocks.
    """

    modes: Image
    weights: Image
    shape: tuple[int, int]
    n: int


class Shading:
    """Shading modes of one model, and the matrices that map a frame to their coefficients.

    Without a known field the only mode is an evenly bright object.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.box: Box = model.box
        known = isfinite(model.grid.radius_samples)
        count = (DEGREE + 1) * (DEGREE + 2) // 2 if known else 1
        top, bottom, left, right = self.box
        self._modes = np.empty((count, (bottom - top) * (right - left)), np.float32)
        on_blocks = []
        seen = []
        for row, mode in zip(self._modes, modes(model) if known else [model.mask], strict=True):
            row[:] = mode[top:bottom, left:right].ravel()
            on_blocks.append(self._torus_of_blocks(mode))
            seen.append(blocks(model.blur(mode)[model.grid.slices], self.block).ravel())
        self._spectra = np.asarray(scipy_fft.rfft2(np.stack(on_blocks)), np.complex64)
        self._ridge = np.full(count + known, RIDGE)
        self._ridge[count:] = STRAY_RIDGE
        self._beyond_blocks = np.stack(seen) - self._blurred_on_blocks()
        self.refocus()

    def refocus(self) -> None:
        """Blur the modes with the present OTF of the model, as means over blocks, and update the normal equations."""
        seen = self._blurred_on_blocks() + self._beyond_blocks
        self._stray_scale = float(seen[0].max())
        if len(self._ridge) > len(seen):
            seen = np.vstack([seen, np.full_like(seen[:1], self._stray_scale)])  # on the same scale
        self._normal_equations(seen)

    def _blurred_on_blocks(self) -> Image:
        """Return the blurred modes in the window as block means, (modes, blocks) float32, without the edge's part.

        Block mean and blur commute, and except for its edge a mode has no detail finer than a block. The blur is
        therefore computed on a torus of blocks (4 x 4: sixteen times fewer samples), with the low frequencies of the
        OTF. `refocus` adds `_beyond_blocks`, the part of the edge, which is computed once on all samples: it changes
        little with the PSF.
        """
        otf = self._model.otf
        n = self.block
        rows, cols = (size // n for size in self._model.grid.shape)
        low = otf[np.fft.fftfreq(rows, 1 / rows).astype(int)][:, : cols // 2 + 1]
        high, wide = (size // n for size in self._model.grid.window)
        seen: Image = scipy_fft.irfft2(self._spectra * low, (rows, cols))[:, :high, :wide]
        return seen.reshape(len(seen), -1)

    @property
    def blurred(self) -> "BlurredModes":
        """Blurred modes and weights with the PSF of the last `refocus`."""
        rows, cols = (size // self.block for size in self._model.grid.window)
        return BlurredModes(self._seen[: len(self._modes)], self._weights, (rows, cols), self.block)

    @property
    def block(self) -> int:
        """Side of a block in samples: BLOCK if whole blocks fill the torus and fit into the window, else 1."""
        whole = all(size % BLOCK == 0 for size in self._model.grid.shape)
        return BLOCK if whole and min(self._model.grid.window) >= BLOCK else 1

    def _torus_of_blocks(self, mode: Image) -> Image:
        """Return the means over the blocks of the torus, counted from the window's corner."""
        n = self.block
        (top, left) = self._model.grid.at
        rows, cols = (size // n for size in mode.shape)
        moved = np.roll(mode, (-top, -left), (0, 1))
        return _means(moved.reshape(rows, n, cols * n), n)

    def _normal_equations(self, seen: Image) -> None:
        """Set up the weighted ridge regression with the weights of shot noise under an even field."""
        self._seen = seen
        self._weights = np.asarray(1 / (np.maximum(seen[0], 0) / seen[0].max() + 0.03), np.float32)
        self._weighted = np.asarray(seen * self._weights, np.float32)
        self._inverse = self._inverted(self._weighted)

    def _inverted(self, weighted: Image) -> NDArray[np.float64]:
        """Return the inverse of the regularised normal matrix, (modes, modes), for modes weighted block by block."""
        normal = weighted @ self._seen.T
        return np.asarray(np.linalg.inv(normal + np.diag(self._ridge * np.diag(normal))), np.float64)

    def fit(self, frame: Linear, out: Image) -> tuple[float, float]:
        """Write the smooth object (not blurred) to `out` (grid, float32); return its mean level and stray light in DN.

        The stray light is 0 without a known field. Missing samples have weight 0; otherwise the fit would follow the
        zeros in a gap.
        """
        coefficients = self._coefficients(frame)
        top, bottom, left, right = self.box
        out[:] = 0
        smooth = coefficients[: len(self._modes)] @ self._modes
        out[top:bottom, left:right] = smooth.reshape(bottom - top, right - left)
        stray = float(coefficients[-1]) * self._stray_scale if len(coefficients) > len(self._modes) else 0.0
        return float(coefficients[0]), stray

    def unexplained(self, frame: Linear, places: NDArray[np.intp]) -> Image:
        """Return what the fit leaves of the means over these blocks, float32 (places,); 0 for missing blocks."""
        share, means = block_means(frame, self.block)
        left = means[places] - self._coefficients(frame) @ self._seen[:, places]
        return np.asarray(left * (share[places] > 0), np.float32)

    def _coefficients(self, frame: Linear) -> Image:
        """Return the coefficients of the modes, the stray light last, float32."""
        if frame.has_gaps:
            return self._fit_with_gaps(frame).astype(np.float32)
        return np.asarray(self._inverse @ (self._weighted @ blocks(frame.y, self.block).ravel()), np.float32)

    def _fit_with_gaps(self, frame: Linear) -> NDArray[np.float64]:
        """Return the coefficients, stray light last, with each block weighted by its share of good pixels."""
        share, means = block_means(frame, self.block)
        weighted = self._weighted * share
        return np.asarray(self._inverted(weighted) @ (weighted @ means), np.float64)


def block_means(frame: Linear, n: int) -> tuple[Image, Image]:
    """Return the good share of each n x n block of a frame and the mean of its good pixels, float32 (blocks,)."""
    share = blocks(frame.good, n).ravel()
    share[share < MIN_GOOD] = 0
    light = blocks(frame.y * frame.good, n).ravel()
    return share, np.divide(light, share, out=np.zeros_like(light), where=share > 0)


def blocks(image: Image, n: int) -> Image:
    """Return the means over n x n samples, without the incomplete blocks at the far edges."""
    rows, cols = (size // n for size in image.shape)
    return _means(image[: rows * n, : cols * n].reshape(rows, n, cols * n), n)


def _means(bands: Image, n: int) -> Image:
    """Return the means over n columns of the bands (rows, n, cols n): along whole rows first, four times as fast."""
    means: Image = bands.mean(axis=1).reshape(len(bands), -1, n).mean(axis=2)
    return means


def modes(model: Model) -> Iterator[Image]:
    """Yield the modes of `zernike_modes` on the field's disc, each float32 of the grid's shape and 0 outside it."""
    top, bottom, left, right = model.box
    v = (np.arange(top, bottom)[:, None] - model.grid.centre[0]) / model.grid.radius_samples
    u = (np.arange(left, right)[None] - model.grid.centre[1]) / model.grid.radius_samples
    disc = model.mask[top:bottom, left:right]
    for lit in zernike_modes(v, u):
        mode = np.zeros(model.grid.shape, np.float32)
        mode[top:bottom, left:right] = disc * lit
        yield mode


def zernike_modes(v: NDArray[np.floating], u: NDArray[np.floating]) -> Iterator[NDArray[np.floating]]:
    """Yield the Zernike polynomials up to radial degree DEGREE at (v, u) (down, right) in radii, not normalised.

    The constant mode is first; the order is n, then m, ascending (m < 0: sine). Beyond the unit disc each continues
    with its value at the edge.
    """
    radius = np.minimum(np.hypot(u, v), 1)
    angle = np.arctan2(v, u)
    powers = [np.ones_like(radius)]
    for _ in range(DEGREE):
        powers.append(powers[-1] * radius)
    cosines = [np.cos(m * angle) for m in range(DEGREE + 1)]
    sines = [np.sin(m * angle) for m in range(DEGREE + 1)]
    for n in range(DEGREE + 1):
        for m in range(-n, n + 1, 2):
            yield _radial(n, abs(m), powers) * (cosines[m] if m >= 0 else sines[-m])


def _radial(n: int, m: int, powers: list[NDArray[np.floating]]) -> NDArray[np.floating]:
    """Return the radial polynomial of Zernike from the powers 0..n of the radius."""
    total = np.zeros_like(powers[0])
    for k in range((n - m) // 2 + 1):
        below = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total += (-1) ** k * factorial(n - k) / below * powers[n - 2 * k]
    return total
