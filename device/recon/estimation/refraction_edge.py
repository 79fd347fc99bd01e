"""Field edge in the likelihood of a refraction: diameter, centre and softness of the lit disc, estimated with the eye.

A cropped sensor shows only the inner part of the PSF of a point at the field edge, so that a displaced edge looks like
another refraction: 0.1 deg costs 0.4 dpt at 33.4 deg and 0.75 dpt at 45 deg on an IMX296. The edge is therefore not
taken from the calibration. For each candidate eye T the likelihood of `refraction` is minimised over the edge e:

    E(T) = min over e of  sum over f of  log S + |R_T - sum_k e_k R_T,k|^2 / S  +  |e / PRIOR|^2

R_T,k is the tapered spectrum of the derivative of smooth object times edge with respect to e_k (radius, centre, width),
blurred by the candidate's PSF. It is a generalised least-squares step with the spectrum S of the retina's detail as
covariance; the steps are repeated with the smooth object fitted anew within the edge found (NUMERICS.md 7.5).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.recon.estimation.psf_warp import Transform
from device.recon.estimation.refraction_likelihood import SMEAR, TURNS, Band, RefractionLikelihood
from device.recon.estimation.shading import BLOCK, RIDGE, STRAY_RIDGE, blocks, zernike_modes
from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.grid import Pair
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import LEAST_GOOD, Linear
from device.values import Calibration, Geometry, Image

SAMPLE_UM = 24.0
MARGIN_DEG = 1.5  # from the calibrated edge to the end of the range of the radius and of half the width
FIRST_WIDTH_DEG = 0.4  # of the first model: a step has no derivative with respect to its width
PRIOR_DEG = (0.5, 0.2, 0.2, 1.0)  # sd of radius, centre (down, right) and width around the calibrated edge
LARGEST_STEP_DEG = 0.3  # of one iteration: the linear model holds within the structure of the caustic
PARAMETERS = 4

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Edge:
    """Lit disc: radius, centre (down, right of the sensor's) and full width of its cosine ramp, in samples or degrees.

    The light is one half at the radius. A width below one sample counts as one sample.
    """

    radius: float
    down: float
    right: float
    width: float

    @property
    def vector(self) -> Floats:
        """The four parameters as an array."""
        return np.array([self.radius, self.down, self.right, self.width])

    def scaled(self, factor: float) -> "Edge":
        """Return the edge in another unit."""
        return Edge(*(self.vector * factor))

    def light(self, rows: Image, cols: Image) -> Image:
        """Return the share of the light at positions relative to the sensor's centre, 0 to 1."""
        share: Image = 0.5 - 0.5 * np.cos(np.pi * self._ramp(rows, cols)[0])
        return share.astype(np.float32)

    def derivatives(self, rows: Image, cols: Image) -> tuple[Image, ...]:
        """Return the derivatives of `light` with respect to the four parameters."""
        ramp, radius, width = self._ramp(rows, cols)
        slope = np.float32(0.5 * np.pi) * np.sin(np.pi * ramp) / width
        outward = 1 / np.maximum(radius, 1)
        return (
            slope, slope * (rows - self.down) * outward, slope * (cols - self.right) * outward,
            slope * (0.5 - ramp),
        )  # fmt: skip

    def _ramp(self, rows: Image, cols: Image) -> tuple[Image, Image, np.float32]:
        radius = np.hypot(rows - np.float32(self.down), cols - np.float32(self.right))
        width = np.float32(max(self.width, 1.0))
        return np.clip((np.float32(self.radius) - radius) / width + np.float32(0.5), 0, 1), radius, width


@dataclass(frozen=True)
class Candidate:
    """Likelihood of one candidate eye with its best edge.

    `nats` is the negative log likelihood (up to a constant) with the penalty of the edge, `terms` its part of each
    frequency, (K,), `step` the change of the edge in samples, `information` its matrix (inverse covariance).
    """

    nats: float
    terms: Floats
    step: Floats
    information: Floats


class EdgeLikelihood:
    """Negative log likelihood of an eye with an unknown field edge, for one calibration and one sensor shape."""

    def __init__(self, calibration: Calibration, geometry: Geometry, shape: Pair, planner: Planner, index: int) -> None:
        assert calibration.field_deg is not None
        wide = replace(calibration, field_deg=calibration.field_deg + 2 * MARGIN_DEG)
        self.likelihood = RefractionLikelihood(wide, geometry, shape, planner, index, SAMPLE_UM)
        self.grid = self.likelihood.grid
        self.per_deg = geometry.px_per_deg / self.grid.n
        self.calibrated = Edge(calibration.field_deg / 2, 0.0, 0.0, FIRST_WIDTH_DEG).scaled(self.per_deg)
        self.edge = self.calibrated
        self._prior = np.asarray(PRIOR_DEG) * self.per_deg
        self._place_box()
        radius = self.calibrated.radius
        self._modes = np.stack([mode.ravel() for mode in zernike_modes(self._rows / radius, self._cols / radius)])
        self._objects: list[Spectrum] = [np.zeros(0, np.complex64)] * PARAMETERS
        self._flat_places = np.arange(self.band.where.size)
        self._levels = np.zeros(int(self.band.ring.max(initial=0)) + 1)
        self.noise_dn2 = 1.0

    @property
    def band(self) -> Band:
        """Frequencies of the likelihood."""
        return self.likelihood.bands.whole

    def _place_box(self) -> None:
        """Set the box of blocks around the largest field: its samples on the torus, and their positions."""
        starts, sizes = [], []
        reach = self.calibrated.radius + MARGIN_DEG * self.per_deg + 2
        for at, middle in zip(self.grid.at, self.grid.centre, strict=True):
            low = int(np.floor((middle - reach - at) / BLOCK)) * BLOCK + at
            starts.append(low)
            sizes.append(int(np.ceil((middle + reach - low) / BLOCK)) * BLOCK)
        indices = [np.arange(low, low + size) for low, size in zip(starts, sizes, strict=True)]
        self._box = np.ix_(*(index % size for index, size in zip(indices, self.grid.shape, strict=True)))
        self._coarse_box = np.ix_(*(
            np.arange(size // BLOCK) + (low - at) // BLOCK
            for low, size, at in zip(starts, sizes, self.grid.at, strict=True)
        ))  # fmt: skip
        rows, cols = (
            index.astype(np.float32) - np.float32(middle)
            for index, middle in zip(indices, self.grid.centre, strict=True)
        )
        self._rows, self._cols = (np.ascontiguousarray(x) for x in np.broadcast_arrays(rows[:, None], cols[None]))

    def start(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Linear:
        """Return the frame on this model's samples, and begin with the calibrated edge."""
        self.frame = self.likelihood.frame(counts, dark, defects)
        self.edge = self.calibrated
        self.noise_dn2 = 1.0
        return self.frame

    def set_noise(self) -> None:
        """Set the noise from the sensor's gain, or from the last residual."""
        self.noise_dn2 = self.likelihood.noise_power(self.frame)

    def fit_smooth(self, stretch: Transform) -> float:
        """Fit the smooth object within the present edge for the PSF with this stretch; return its mean level in DN."""
        otf = self.likelihood.interpolated_otf.on_grid(self.grid.shape, self.grid.n, stretch)
        light = self.edge.light(self._rows, self._cols)
        coefficients, stray = self._fit(self._seen_blocks(otf, light))
        smooth = (coefficients[: len(self._modes)].astype(np.float32) @ self._modes).reshape(light.shape)
        image = np.zeros(self.grid.shape, np.float32)
        image[self._box] = smooth * light
        self.likelihood.set_smooth(self.frame, image, stray, otf)
        fft = self.likelihood.model.fft
        for k, derivative in enumerate(self.edge.derivatives(self._rows, self._cols)):
            fft.space[:] = 0
            fft.space[self._box] = smooth * derivative
            self._objects[k] = fft.forward().copy()
        return float(coefficients[0])

    def _seen_blocks(self, otf: Spectrum, light: Image) -> Image:
        """Return modes times light, blurred, as means over the blocks of the window, (modes, blocks)."""
        rows, cols = (size // BLOCK for size in self.grid.shape)
        high, wide = (size // BLOCK for size in self.grid.window)
        box = (light.shape[0] // BLOCK, BLOCK, light.shape[1] // BLOCK, BLOCK)
        lit = (self._modes * light.ravel()).reshape(len(self._modes), *box).mean(axis=(2, 4))
        torus = np.zeros((len(lit), rows, cols), np.float32)
        down, right = self._coarse_box
        torus[:, down % rows, right % cols] = lit
        low = otf[np.fft.fftfreq(rows, 1 / rows).astype(int)][:, : cols // 2 + 1]
        seen: Image = scipy_fft.irfft2(scipy_fft.rfft2(torus) * low, (rows, cols))[:, :high, :wide]
        return np.ascontiguousarray(seen.reshape(len(lit), -1))

    def _fit(self, seen: Image) -> tuple[Floats, float]:
        """Return the coefficients of the modes, and the stray light in DN, by weighted ridge regression."""
        brightest = float(seen[0].max())
        every = np.vstack([seen, np.full_like(seen[:1], brightest)])
        share = blocks(self.frame.good, BLOCK).ravel()
        share[share < LEAST_GOOD] = 0
        light = blocks(self.frame.y * self.frame.good, BLOCK).ravel()
        means = np.divide(light, share, out=np.zeros_like(light), where=share > 0)
        weighted = every * (share / (np.maximum(seen[0], 0) / brightest + 0.03))
        normal = (weighted @ every.T).astype(np.float64)
        ridge = np.full(len(every), RIDGE)
        ridge[-1] = STRAY_RIDGE
        coefficients = np.linalg.solve(normal + np.diag(ridge * np.diag(normal)), weighted @ means)
        return coefficients, float(coefficients[-1]) * brightest

    def __call__(self, stretch: Transform, count: int = PARAMETERS) -> Candidate:
        """Return the likelihood of an eye, minimised over the first `count` parameters of the edge."""
        likelihood, band = self.likelihood, self.band
        level = likelihood.residual_of(self.frame, stretch)[0]
        rest = likelihood.fft.spectrum.ravel()[band.where]
        otf = likelihood.interpolated_otf.at_frequencies(band.rows, band.cols, band.share, self.grid.n, stretch)
        nats = self._nats(rest, otf)
        step, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        if count:
            moved = np.stack(
                [np.float32(level) * likelihood.spectrum_of(part).ravel()[band.where] for part in self._objects[:count]]
            )
            weighted = moved.conj() / self._spectrum()
            penalty = 1 / self._prior[:count] ** 2
            away = (self.edge.vector - self.calibrated.vector)[:count]
            matrix = (weighted @ moved.T).real.astype(np.float64) + np.diag(penalty)
            found = np.linalg.solve(matrix, (weighted @ rest).real - penalty * away)
            nats = self._nats(rest - found.astype(np.float32) @ moved, otf) + float(penalty @ (away + found) ** 2)
            step[:count], information[:count, :count] = found, matrix
        model = self._spectrum()
        return Candidate(nats, (np.log(model) + band.energy / model).astype(np.float64), step, information)

    def _nats(self, rest: Spectrum, otf: Spectrum) -> float:
        band = self.band
        return fused_kernels.negative_log_likelihood(
            rest[None], otf, self._flat_places, band.ring, self.noise_dn2, SMEAR, TURNS, self._levels, band.energy,
            band.power,
        )  # fmt: skip

    def _spectrum(self) -> Image:
        """Return the model S of the last likelihood, (K,)."""
        return np.asarray(self.band.power * self._levels[self.band.ring] + self.noise_dn2, np.float32)

    def move_edge(self, step: Floats) -> float:
        """Move the edge by `step` (samples), within its range; return the largest change in samples."""
        largest = LARGEST_STEP_DEG * self.per_deg
        wanted = self.edge.vector + np.clip(step, -largest, largest)
        reach = MARGIN_DEG * self.per_deg
        low = self.calibrated.vector - np.array([reach, reach, reach, np.inf])
        high = self.calibrated.vector + np.array([reach, reach, reach, np.inf])
        low[3], high[3] = 1.0, 2 * reach
        found = np.clip(wanted, low, high)
        change = float(np.abs(found - self.edge.vector).max())
        self.edge = Edge(*found)
        return change
