"""Linear model of a cropped frame around one eye: the fit of smooth part and detail, and the derivatives of the frame.

The model of the frame y (NUMERICS.md 7.7) is

    y = C h_T * (s + a t) + Q c + noise,     t: stationary Gaussian with the spectrum P,   c: free

C is the crop by the sensor, h_T the stretched PSF, s the smooth part within its edge, a 1 in the field plus a margin
and 0 outside, and Q holds the smoothest cosines of the window: stray light, the PSF beyond its support, and an uneven
flat frame. K is the covariance of y for free c; K^-1 is applied by conjugate gradients in the Fourier domain.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.noise import Noise
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.field import Edge
from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Planner, RealFft, Spectrum
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import MIN_GOOD, Linear
from device.values import Image

COSINES = 10  # per axis
DETAIL_EXPONENT = -2.5  # of the spectrum P; exponents from -2 to -3 give the same eyes
REFERENCE = 0.1  # cycles per sample, at which the level of P is fitted to the rings
FLATTEST = 0.02  # cycles per sample, below which P is constant
FITTED_RINGS = 10
MIN_LEVEL = 1e-4  # of the highest one; a ring without detail has a floor instead of a level
MARGIN_SAMPLES = 4.0  # from the end of the edge to the end of the object
MAX_ITERATIONS = 30  # of conjugate gradients; 40, 80 and 300 move an estimate by up to 0.3 sd, the RMS error stays
COVARIANCE_ITERATIONS = 20  # for covariance and bias: the sds change by 1 % at the most
RESIDUAL_SHARE = 1e-7  # of the first squared residual, at which the iteration ends
DARK_SHARE = 0.1  # of the mean
NEAR_SAMPLES = 5  # side of the square of the local mean
RIDGE = 1e-5  # of the mean information on a cosine, for windows whose dark part leaves some of them undetermined
MODEL_SHARE = 0.0022  # of the mean: sd of what the model lacks
SPOT_MODEL_SHARE = 0.005  # behind lenslets, whose foci differ over the field: residuals of bright frames
DERIVATIVE_STEP_DPT = 0.05

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Weighting:
    """Weights of the samples of one frame's window: one over the variance of each, 0 for missing ones.

    The cosines `down` and `across`, (COSINES, rows) and (COSINES, cols), are free: their products are taken out.
    """

    weights: Image
    down: Image
    across: Image
    inverse_normal: Floats

    @classmethod
    def of(cls, frame: Linear, noise: Noise, least_dn: float, model_share: float = MODEL_SHARE) -> "Weighting":
        """Return the weights for the noise of a sample and for what the model lacks, `model_share` of the mean.

        They follow the local mean: by a sample itself, noise would weigh itself, and choose its own samples. Samples
        darker than `least_dn`, or than DARK_SHARE of the mean if that is less, have none; 0: all are used.
        """
        model_dn = model_share * frame.mean_dn
        is_used = frame.good >= MIN_GOOD
        near = ndimage.uniform_filter(np.where(is_used, frame.y, 0), NEAR_SAMPLES)
        near /= np.maximum(ndimage.uniform_filter(is_used.astype(np.float32), NEAR_SAMPLES), 1 / NEAR_SAMPLES**2)
        variance_dn2 = noise.per_dn * np.maximum(near, 0) + noise.floor_dn2 + model_dn**2
        if least_dn > 0:
            is_used &= near >= min(least_dn, DARK_SHARE * frame.mean_dn)
        weights = (is_used / variance_dn2).astype(np.float32)
        down, across = (_cosines(size) for size in frame.y.shape)
        by_rows = np.einsum("ai,bi,ij->abj", down, down, weights, optimize=True)
        normal = np.einsum("abj,cj,dj->acbd", by_rows, across, across, optimize=True)
        flat = normal.reshape(COSINES**2, COSINES**2).astype(np.float64)
        flat += np.eye(COSINES**2) * (RIDGE * np.trace(flat) / COSINES**2)
        return cls(weights, down, across, np.asarray(np.linalg.inv(flat)))

    def __call__(self, frame: Image) -> Image:
        """Return a frame times the weights, without the part that the cosines explain."""
        weighted = self.weights * frame
        part = self.inverse_normal @ (self.down @ weighted @ self.across.T).ravel().astype(np.float64)
        weighted -= self.weights * (self.down.T @ part.reshape(COSINES, COSINES).astype(np.float32) @ self.across)
        return weighted


@dataclass(frozen=True)
class Fit:
    """Fit of one frame for one eye: whitened spectrum of the detail, K^-1 times the residual, expected frame, and D.

    `object` is the spectrum of smooth part and detail, `derivatives` (D) are those of the expected frame with respect
    to M, J0 and J45.
    """

    detail: Spectrum
    object: Spectrum
    weighted: Image
    expected: Image
    derivatives: list[Image]

    @property
    def score(self) -> Floats:
        """D' K^-1 times the residual, one value for each derivative."""
        return np.array([np.vdot(part, self.weighted) for part in self.derivatives], np.float64)


class CropModel:
    """Model of the frame that an `EdgeLikelihood` was started with, on the same grid, for a PSF with this radius.

    `seen_share`, from `start` on: area of the window over that of the blurred field; below 1 light is cropped.
    """

    def __init__(self, edges: EdgeLikelihood, planner: Planner, psf_radius_px: float) -> None:
        self._edges = edges
        grid = edges.grid
        self._grid = grid
        self._psf_samples = psf_radius_px / grid.n
        self._fft: RealFft = planner.plan(grid.shape)
        rows, cols = grid.shape
        self._rows = (np.arange(rows, dtype=np.float32) - np.float32(grid.centre[0]))[:, None]
        self._cols = (np.arange(cols, dtype=np.float32) - np.float32(grid.centre[1]))[None]
        frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
        self._root_shape = (np.maximum(frequency, FLATTEST) / REFERENCE) ** (DETAIL_EXPONENT / 2)
        self._twice = np.full(cols // 2 + 1, 2.0)
        self._twice[0] = 1
        if cols % 2 == 0:
            self._twice[-1] = 1
        self._otf = np.zeros(frequency.shape, np.complex64)
        self.seen_share = 1.0

    def start(self, eye_dpt: Floats) -> None:
        """Set the weights of the frame's samples, and the object's prior from the likelihood of an eye."""
        edges = self._edges
        share = SPOT_MODEL_SHARE if edges.likelihood.geometry.has_spots else MODEL_SHARE
        self._weighting = Weighting.of(edges.frame, edges.noise, edges.dithered_dn, share)
        self._set_prior(eye_dpt)

    def focus(self, eye_dpt: Floats) -> None:
        """Set OTF, its derivatives and the preconditioner to an eye."""
        likelihood, grid = self._edges.likelihood, self._grid
        stretch = likelihood.stretch(*eye_dpt)
        likelihood.interpolated_otf.on_grid(grid.shape, grid.n, stretch, self._otf)
        self._focus_on(self._otf, [_slope(self._edges, eye_dpt, step) for step in np.eye(3) * DERIVATIVE_STEP_DPT])

    def _focus_on(self, otf: Spectrum, slopes: list[Spectrum]) -> None:
        """Set the OTF, its derivatives, and the preconditioner."""
        self._otf, self._slopes = otf, slopes
        power = np.abs(otf) ** 2 * self._root**2
        self._preconditioner = (1 / (1 + self._mean_weight * power)).astype(np.float32)

    def fit(self, light: Image, start: Spectrum | None, most: int = MAX_ITERATIONS) -> Fit:
        """Return the fit of a frame for the eye in focus, with a smooth part of its own, from the detail `start` on."""
        smooth = self._edges.field.fit(replace(self._edges.frame, y=light), self._otf, self._edges.edge).image
        seen = self._seen(self._spectrum(smooth))
        detail, weighted, fitted = self._solve((light - seen).astype(np.float32), start, most)
        spectrum = self._spectrum(smooth + self._object(detail))
        return Fit(detail, spectrum, weighted, seen + fitted, [self._seen(spectrum, slope) for slope in self._slopes])

    def misfit(self, light: Image, fit: Fit) -> float:
        """Return the squared residual of a frame over its noise, per sample that is used."""
        return float(np.vdot(fit.weighted, light - fit.expected)) / np.count_nonzero(self._weighting.weights)

    def covariance(self, derivatives: list[Image]) -> Floats:
        """Return the inverse of D' K^-1 D for the derivatives D of the frame, (3, 3)."""
        solved = [self._solve(part, None, COVARIANCE_ITERATIONS)[1] for part in derivatives]
        matrix = np.array([[np.vdot(a, b) for b in derivatives] for a in solved], np.float64)
        return np.asarray(np.linalg.inv((matrix + matrix.T) / 2))

    def _set_prior(self, eye_dpt: Floats) -> None:
        """Set the object's reach from the edge, and the level of its detail from the rings of the likelihood."""
        edges = self._edges
        edge = self._edges.edge
        frequencies, levels = detail_levels(edges, eye_dpt)
        lit = np.pi * edge.radius_samples**2
        seen = self.seen_share = seen_share(self._grid, edge, self._psf_samples)
        share = min(seen * float((edges.likelihood.taper**2).mean()), 1.0)
        logs = np.log(levels) - DETAIL_EXPONENT * np.log(frequencies / REFERENCE)
        self._root = (self._root_shape * np.exp(logs.mean() / 2) / np.sqrt(lit * share)).astype(np.float32)
        radius = np.hypot(self._rows - np.float32(edge.down_samples), self._cols - np.float32(edge.right_samples))
        reach = edge.radius_samples + edge.width_samples / 2 + MARGIN_SAMPLES
        within = np.clip((np.float32(reach) - radius) / 2, 0, 1).astype(np.float32)
        self._reach = within / np.float32(self._grid.size)  # with the scale of an inverse FFT
        self._mean_weight = float(self._weighting.weights.mean()) * min(seen, 1.0)

    def _spectrum(self, image: Image) -> Spectrum:
        self._fft.space[:] = image
        return self._fft.forward().copy()

    def _seen(self, spectrum: Spectrum, otf: Spectrum | None = None) -> Image:
        """Return the frame of an object's spectrum."""
        np.multiply(spectrum, self._otf if otf is None else otf, out=self._fft.spectrum)
        return self._fft.inverse()[self._grid.slices] / np.float32(self._grid.size)

    def _object(self, detail: Spectrum) -> Image:
        """Return the detail of the object (a view) that a whitened spectrum stands for."""
        fused_kernels.filter_spectrum(detail, self._root, self._fft.spectrum)
        space = self._fft.inverse()
        space *= self._reach
        return space

    def _blurred(self, detail: Spectrum) -> Image:
        """Return the frame of a whitened spectrum."""
        self._object(detail)
        spectrum = self._fft.forward()
        spectrum *= self._otf
        return self._fft.inverse()[self._grid.slices] / np.float32(self._grid.size)

    def _adjoint_in_fft(self, frame: Image) -> Spectrum:
        """Return the adjoint of `_blurred` before the whitening, in the array of the FFT."""
        space = self._fft.space
        space[:] = 0
        space[self._grid.slices] = frame
        fused_kernels.multiply_conjugate(self._fft.forward(), self._otf)
        space = self._fft.inverse()
        space *= self._reach
        return self._fft.forward()

    def _adjoint(self, frame: Image) -> Spectrum:
        """Return the adjoint of `_blurred`, a new array."""
        adjoint = np.empty_like(self._otf)
        fused_kernels.filter_spectrum(self._adjoint_in_fft(frame), self._root, adjoint)
        return adjoint

    def _solve(self, frame: Image, start: Spectrum | None, most: int = MAX_ITERATIONS) -> tuple[Spectrum, Image, Image]:
        """Return the whitened spectrum of a frame's detail, K^-1 times the frame, and the frame of the detail."""
        detail = np.zeros_like(self._otf) if start is None else start.copy()
        fitted = np.zeros(self._grid.window, np.float32) if start is None else self._blurred(detail)
        rest = self._adjoint(self._weighting(frame - fitted)) - detail
        first = fused_kernels.squared_length(self._adjoint(self._weighting(frame)), self._preconditioner, self._twice)
        direction = np.zeros_like(rest)
        moved = np.empty_like(rest)
        size = fused_kernels.squared_length(rest, self._preconditioner, self._twice)
        ratio = 0.0
        for _ in range(most):
            if size <= RESIDUAL_SHARE * first:
                break
            fused_kernels.next_direction(ratio, rest, self._preconditioner, direction)
            seen = self._blurred(direction)
            normal = self._adjoint_in_fft(self._weighting(seen))
            curvature = fused_kernels.add_normal_part(normal, self._root, direction, self._twice, moved)
            factor = size / curvature
            before = size
            size = fused_kernels.step_along(factor, direction, moved, self._preconditioner, self._twice, detail, rest)
            fitted += np.float32(factor) * seen
            ratio = size / before
        return detail, self._weighting(frame - fitted), fitted


def _slope(edges: EdgeLikelihood, eye_dpt: Floats, step_dpt: Floats) -> Spectrum:
    """Return the derivative of the OTF with respect to the eye along a small step, per dpt."""
    likelihood, grid = edges.likelihood, edges.grid
    above, below = (
        likelihood.interpolated_otf.on_grid(grid.shape, grid.n, likelihood.stretch(*(eye_dpt + sign * step_dpt)))
        for sign in (1, -1)
    )
    return np.asarray((above - below) / np.float32(2 * DERIVATIVE_STEP_DPT), np.complex64)


def seen_share(grid: Grid, edge: Edge, psf_samples: float) -> float:
    """Return the area of the window over that of the blurred field, for a PSF with this radius."""
    return float(np.prod(grid.window)) / (np.pi * (edge.radius_samples + psf_samples) ** 2)


def detail_levels(edges: EdgeLikelihood, eye_dpt: Floats) -> tuple[Floats, Floats]:
    """Return mean frequency (cycles per sample) and level of the retina's detail of the first rings with detail."""
    levels = edges(eye_dpt).levels[:FITTED_RINGS]
    band = edges.band
    count = band.rings
    sums = np.bincount(band.ring, np.hypot(band.rows, band.cols), count).astype(np.float64)
    frequency = sums / np.maximum(np.bincount(band.ring, minlength=count), 1)
    is_known = levels > MIN_LEVEL * levels.max()
    return frequency[:FITTED_RINGS][is_known], levels[is_known]


def _cosines(size: int) -> Image:
    """Return the first COSINES functions of the discrete cosine transform, (COSINES, size), with unit norm."""
    place = (np.arange(size) + 0.5) / size
    functions = np.cos(np.pi * np.arange(COSINES)[:, None] * place)
    unit: Image = (functions / np.linalg.norm(functions, axis=1, keepdims=True)).astype(np.float32)
    return unit
