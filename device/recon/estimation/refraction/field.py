"""Lit field of a frame with an adjustable edge: smooth part of the object times a soft disc, and its derivatives.

The smooth part is the one of `shading`: Zernike polynomials, fitted to block means of the frame through one PSF. There
the edge is the calibrated one; here radius, centre and width of the edge may differ from one fit to the next.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.recon.estimation.background import SensorPolynomial, joint_background, without
from device.recon.estimation.shading import BLOCK, RIDGE, STRAY_RIDGE, block_means, zernike_modes
from device.recon.model.fft_plans import Spectrum
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Linear
from device.values import Calibration, Image

MARGIN_DEG = 1.5  # from the calibrated edge to the end of the range of the radius and of half the width
FIRST_WIDTH_DEG = 0.4  # of the first model: a step has no derivative with respect to its width
PRIOR_DEG = (0.5, 0.2, 0.2, 1.0)  # sqrt(2) sd of radius, centre (down, right) and width around the calibrated edge
LARGEST_STEP_DEG = 0.3  # of one iteration: the linear model holds within the structure of the caustic
SOFT_WIDTH_DEG = 9.0  # from this width on uncertainty and range of an edge grow in proportion to its width
MIN_WEIGHT = 0.03  # of the brightest block, added for the read noise

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Edge:
    """Lit disc in samples: radius, centre (down, right of the sensor's) and full width of its cosine ramp.

    The light is one half at the radius. A width below one sample counts as one sample.
    """

    radius_samples: float
    down_samples: float
    right_samples: float
    width_samples: float

    @property
    def vector(self) -> Floats:
        """The four parameters as an array."""
        return np.array([self.radius_samples, self.down_samples, self.right_samples, self.width_samples])

    def light(self, rows: Image, cols: Image) -> Image:
        """Return the share of the light at positions relative to the sensor's centre, 0 to 1."""
        share: Image = 0.5 - 0.5 * np.cos(np.pi * self._ramp(rows, cols)[0])
        return share.astype(np.float32)

    def derivatives(self, rows: Image, cols: Image) -> tuple[Image, ...]:
        """Return the derivatives of `light` with respect to the four parameters."""
        ramp, radius, width = self._ramp(rows, cols)
        slope = np.float32(0.5 * np.pi) * np.sin(np.pi * ramp) / width
        outward = slope / np.maximum(radius, 1)
        return (
            slope,
            outward * (rows - np.float32(self.down_samples)),
            outward * (cols - np.float32(self.right_samples)),
            slope * (np.float32(0.5) - ramp),
        )

    def _ramp(self, rows: Image, cols: Image) -> tuple[Image, Image, np.float32]:
        radius = np.hypot(rows - np.float32(self.down_samples), cols - np.float32(self.right_samples))
        width = np.float32(max(self.width_samples, 1.0))
        return np.clip((np.float32(self.radius_samples) - radius) / width + np.float32(0.5), 0, 1), radius, width


@dataclass(frozen=True)
class FieldEdge:
    """Lit disc: diameter, centre (down, right of the sensor's) and full width of its cosine ramp, in degrees.

    `diameter_sd_deg` is the standard deviation of the diameter for a known eye: sqrt(2) times the one that independent
    frequencies would have; 0 if the edge was not estimated.
    """

    diameter_deg: float
    down_deg: float
    right_deg: float
    width_deg: float
    diameter_sd_deg: float


class EdgePrior:
    """Expected edge with its uncertainty and range, for diameter and width in degrees, and samples per degree.

    `calibrated` is the edge of the calibration, `expected` the first edge of a frame (at first the same), `precision`
    half the inverse variance of each parameter around it, as in a negative log likelihood, and `largest_samples` the
    largest radius with light.
    """

    def __init__(self, diameter_deg: float, width_deg: float | None, per_deg: float) -> None:
        self._per_deg = per_deg
        width = (width_deg or FIRST_WIDTH_DEG) * per_deg
        self.softness = max(1.0, (width_deg or 0.0) / SOFT_WIDTH_DEG)
        self._reach = MARGIN_DEG * per_deg * self.softness
        self._widest = 2 * self._reach if width_deg is None else 1.5 * width
        self.calibrated = Edge(diameter_deg / 2 * per_deg, 0.0, 0.0, width)
        self.expected = self.calibrated
        self.precision: Floats = (np.asarray(PRIOR_DEG) * (self.softness, 1, 1, self.softness) * per_deg) ** -2
        self.largest_samples = self.calibrated.radius_samples + self._reach + (width / 2 if width_deg else 0.0)

    def around(self, edge: Edge) -> "EdgePrior":
        """Return the prior with another expected edge."""
        prior = copy(self)
        prior.expected = edge
        return prior

    def moved(self, edge: Edge, step: Floats) -> Edge:
        """Return an edge whose first parameters are moved by `step` (samples), within their range."""
        wanted = edge.vector
        largest = LARGEST_STEP_DEG * self._per_deg * self.softness
        wanted[: step.size] += np.clip(step, -largest, largest)
        middle = self.expected.vector[:3]
        radius, down, right = np.clip(wanted[:3], middle - self._reach, middle + self._reach).tolist()
        return Edge(radius, down, right, float(np.clip(wanted[3], 1.0, self._widest)))

    def is_at_end(self, edge: Edge) -> bool:
        """Return True if radius or centre of the edge are at the end of their range."""
        away = np.abs(edge.vector - self.expected.vector)[:3]
        return bool(away.max() > 0.99 * self._reach)

    def in_samples(self, edge: FieldEdge) -> Edge:
        """Return an edge in samples; the inverse of `in_degrees`."""
        parts = edge.diameter_deg / 2, edge.down_deg, edge.right_deg, edge.width_deg
        return Edge(*(part * self._per_deg for part in parts))

    def in_degrees(self, edge: Edge, radius_sd_samples: float) -> FieldEdge:
        """Return an edge in degrees, with the standard deviation of its diameter."""
        radius, down, right, width = (edge.vector / self._per_deg).tolist()
        return FieldEdge(2 * radius, down, right, width, 2 * radius_sd_samples / self._per_deg)


def lamp_light(calibration: Calibration, grid: Grid) -> Image:
    """Return the light of the lamp on an even retina: the ramp of a soft edge, else 1 everywhere, float32 (grid)."""
    if calibration.soft_edge_deg is None or calibration.geometry is None:
        return np.ones(grid.shape, np.float32)
    edge = EdgePrior(*calibration.soft_edge_deg, calibration.geometry.px_per_deg / grid.n).calibrated
    rows, cols = (
        np.arange(size, dtype=np.float32) - np.float32(middle)
        for size, middle in zip(grid.shape, grid.centre, strict=True)
    )
    return edge.light(rows[:, None], cols[None])


@dataclass(frozen=True)
class SmoothField:
    """Smooth part of one frame: object on the grid, its derivatives with respect to the edge, level and stray light.

    `level_dn` is the mean level, `stray_dn` the light that did not pass the diffuser, and `background` its part that is
    uneven, in DN on the window; None: not fitted.
    """

    image: Image
    derivatives: tuple[Image, ...]
    level_dn: float
    stray_dn: float
    background: Image | None


class LitField:
    """Fit of the smooth part within an edge, for one grid, the calibrated edge, and a largest radius."""

    def __init__(self, grid: Grid, calibrated: Edge, largest_samples: float) -> None:
        self._grid = grid
        starts = []
        sizes = []
        for at, middle in zip(grid.at, grid.centre, strict=True):  # whole blocks, counted from the window's corner
            low = int(np.floor((middle - largest_samples - at) / BLOCK)) * BLOCK + at
            starts.append(low)
            sizes.append(int(np.ceil((middle + largest_samples - low) / BLOCK)) * BLOCK)
        places = [np.arange(low, low + size) for low, size in zip(starts, sizes, strict=True)]
        self._box = np.ix_(*(place % size for place, size in zip(places, grid.shape, strict=True)))
        self._torus = (grid.shape[0] // BLOCK, grid.shape[1] // BLOCK)
        self._block_box = tuple(
            ((np.arange(size // BLOCK) + (low - at) // BLOCK) % count)
            for low, size, at, count in zip(starts, sizes, grid.at, self._torus, strict=True)
        )
        rows, cols = (
            place.astype(np.float32) - np.float32(middle) for place, middle in zip(places, grid.centre, strict=True)
        )
        self._rows, self._cols = (np.ascontiguousarray(x) for x in np.broadcast_arrays(rows[:, None], cols[None]))
        radius = np.float32(calibrated.radius_samples)
        self._modes = np.stack([mode.ravel() for mode in zernike_modes(self._rows / radius, self._cols / radius)])
        self._by_block = self._modes.reshape(len(self._modes), sizes[0] // BLOCK, BLOCK, sizes[1] // BLOCK, BLOCK)
        self._even_means = self._by_block.mean(axis=(2, 4))

    def fit(self, frame: Linear, otf: Spectrum, edge: Edge, uneven: SensorPolynomial | None = None) -> SmoothField:
        """Return the smooth part of a frame within an edge, for the PSF with this OTF on the grid.

        `uneven`: polynomial of the background that is fitted with it; None: a constant only.
        """
        light = edge.light(self._rows, self._cols)
        seen = self._blurred_modes(otf, light)
        background = None if uneven is None else joint_background(frame, seen, _weights(seen), uneven, RIDGE)
        coefficients, stray_dn = _ridge_fit(without(frame, background), seen)
        smooth = (coefficients[: len(self._modes)].astype(np.float32) @ self._modes).reshape(light.shape)
        images = [smooth * part for part in (light, *edge.derivatives(self._rows, self._cols))]
        first, *others = (self._on_grid(image) for image in images)
        return SmoothField(first, tuple(others), float(coefficients[0]), stray_dn, background)

    def _on_grid(self, image: Image) -> Image:
        whole = np.zeros(self._grid.shape, np.float32)
        whole[self._box] = image
        return whole

    def _blurred_modes(self, otf: Spectrum, light: Image) -> Image:
        """Return modes times light, blurred, as means over the blocks of the window, (modes, blocks).

        Only the blocks that the edge crosses depend on it.
        """
        by_block = light.reshape(self._by_block.shape[1:])
        least = by_block.min(axis=(1, 3))
        most = by_block.max(axis=(1, 3))
        means = self._even_means * least
        down, right = np.nonzero(least != most)
        crossed = self._by_block[:, down, :, right, :] * by_block[down, :, right, :][:, None]
        means[:, down, right] = crossed.mean(axis=(2, 3)).T
        torus = np.zeros((len(means), *self._torus), np.float32)
        torus[:, self._block_box[0][:, None], self._block_box[1]] = means
        rows, cols = self._torus
        low = otf[np.fft.fftfreq(rows, 1 / rows).astype(int)][:, : cols // 2 + 1]
        high, wide = (size // BLOCK for size in self._grid.window)
        seen: Image = scipy_fft.irfft2(scipy_fft.rfft2(torus) * low, self._torus)[:, :high, :wide]
        return np.ascontiguousarray(seen.reshape(len(means), -1))


def _weights(seen: Image) -> Image:
    """Return the weights of the blocks under shot noise of an even field, `seen[0]`, float32 (blocks,)."""
    return np.asarray(1 / (np.maximum(seen[0], 0) / seen[0].max() + MIN_WEIGHT), np.float32)


def _ridge_fit(frame: Linear, seen: Image) -> tuple[Floats, float]:
    """Return the coefficients of the modes `seen` (modes, blocks), and the stray light in DN.

    Weighted ridge regression with the weights of shot noise under an even field, and of the good share of a block.
    """
    brightest = float(seen[0].max())
    every = np.vstack([seen, np.full_like(seen[:1], brightest)])
    share, means = block_means(frame, BLOCK)
    weighted = every * (share * _weights(seen))
    normal = (weighted @ every.T).astype(np.float64)
    ridge = np.full(len(every), RIDGE)
    ridge[-1] = STRAY_RIDGE
    coefficients = np.linalg.solve(normal + np.diag(ridge * np.diag(normal)), weighted @ means)
    return coefficients, float(coefficients[-1]) * brightest
