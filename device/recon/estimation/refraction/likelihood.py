"""Likelihood of an eye's refraction given one frame: the model that `estimator` searches over M.

E(M) is defined in `estimator`. One object holds the plans of one calibration and sensor shape, and the state of the
frame that `frame` and `fit_smooth` were called with last.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.noise import Noise
from device.recon.estimation.parameter_selection import flat_fit
from device.recon.estimation.power_law_prior import band
from device.recon.estimation.psf_warp import InterpolatedOtf, Transform, transform
from device.recon.estimation.shading import Shading
from device.recon.model import fused_kernels, kernels
from device.recon.model.fft_plans import Planner, RealFft, Spectrum
from device.recon.model.forward_model import dirichlet, taper, tight_model
from device.recon.model.grid import Grid, Pair
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import MIN_GOOD, Linear, Preprocessor
from device.values import Calibration, Geometry, Image, Mask

SAMPLE_UM = 20.0  # as coarse as the caustic's band (3 to 22 cycles/mm) permits
TAPER_UM = 300.0
FADE_SAMPLES = 2.0  # width of the Gaussian that continues detail into a narrow gap
WIDE_SAMPLES, RAMP_SAMPLES = 5, 10  # a gap that contains a square of the first width is tapered over the second
RINGS = 20
REPETITIONS = 4
SMEAR = 0.1  # of a ring's mean |H|^2: leakage of the tapered window from neighbouring frequencies


@dataclass(frozen=True)
class Band:
    """The K frequencies of a search band; every array is (K,).

    `where`: flat index into the window's rfft spectrum. `ring`: 0 to RINGS - 1. `rows`, `cols`: frequency in cycles per
    sample. `share`: transfer of the n x n binning. `energy`, `power`: work arrays.
    """

    where: NDArray[np.int64]
    ring: NDArray[np.int64]
    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    share: Image
    energy: Image
    power: Image

    @classmethod
    def of(cls, window: Pair, low: float, high: float, n: int) -> "Band":
        """Select the frequencies between `low` and `high` (cycles per sample) of the rfft spectrum of `window`.

        `window` is (rows, cols) in samples of n x n pixels; the RINGS rings are equally wide.
        """
        down = np.fft.fftfreq(window[0]).astype(np.float64)
        across = np.fft.rfftfreq(window[1]).astype(np.float64)
        frequency = np.hypot(down[:, None], across[None])
        where = np.flatnonzero((frequency > low) & (frequency < high))
        edges = np.linspace(low, high, RINGS + 1)
        ring = np.clip(np.digitize(frequency.ravel()[where], edges) - 1, 0, RINGS - 1)
        rows = down[where // across.size]
        cols = across[where % across.size]
        share = (dirichlet(rows, n) * dirichlet(cols, n)).astype(np.float32)
        scratch = (np.zeros(where.size, np.float32) for _ in range(2))
        return cls(where, ring, rows, cols, share, *scratch)


@dataclass(frozen=True)
class SearchBands:
    """Frequencies of the search: the band `whole` with the fine structure of |H|^2, and its `upper` half.

    `low` and `high` limit the band, cycles per sample. `stopband` holds the flat indices into the window's rfft
    spectrum of the quarter with the lowest |H|^2.
    """

    low: float
    high: float
    whole: Band
    upper: Band
    stopband: NDArray[np.int64]

    @classmethod
    def of(cls, window: Pair, n: int, interpolated_otf: InterpolatedOtf) -> "SearchBands":
        """Select the frequencies for the stored PSF; `window` is (rows, cols) in samples of n x n pixels."""
        rows = np.fft.fftfreq(window[0])[:, None]
        cols = np.fft.rfftfreq(window[1])[None]
        frequency = np.hypot(rows, cols)
        power = np.abs(interpolated_otf.on_grid(window, n, np.eye(2)).astype(np.complex128)) ** 2
        low, high = band(frequency, power, min(window))
        whole = Band.of(window, low, high, n)
        middle = float(np.median(frequency.ravel()[whole.where])) if whole.where.size else high
        return cls(
            low, high, whole, Band.of(window, middle, high, n), np.flatnonzero(power <= np.quantile(power, 0.25))
        )


@dataclass(frozen=True)
class GapTreatment:
    """Treatment of the missing samples of one frame, each array of the window's shape.

    `weights` is the window's taper, which also falls to 0 at wide gaps. `narrow` marks the samples of narrow gaps,
    `filling` is the detail that is continued into them; both are None for a frame without gaps.
    """

    weights: Image
    narrow: Mask | None = None
    filling: Image | None = None

    @property
    def known_weights(self) -> Image:
        """The weights, 0 in the narrow gaps."""
        return self.weights if self.narrow is None else self.weights * ~self.narrow


class RefractionLikelihood:
    """Negative log likelihood of a mean sphere M for PSF `index` of one calibration, and one sensor shape."""

    def __init__(
        self,
        calibration: Calibration,
        geometry: Geometry,
        shape: Pair,
        planner: Planner,
        index: int,
        sample_um: float = SAMPLE_UM,
    ) -> None:
        self.geometry = geometry
        self.sensor = calibration.sensor
        self.interpolated_otf = InterpolatedOtf(calibration.psfs[index])
        n = max(1, min(round(sample_um / geometry.pitch_um), min(shape) // 16))
        self.model = tight_model(calibration, shape, n, planner, index)
        self._preparer = Preprocessor(calibration, self.grid)
        window = self.grid.window
        self.fft: RealFft = planner.plan(window)
        self.taper = taper(window, min(0.5, TAPER_UM / (geometry.pitch_um * n * min(window))))
        self.bands = SearchBands.of(window, n, self.interpolated_otf)
        self._levels = np.zeros(RINGS)
        self._smooth: Image = np.zeros(self.grid.shape, np.float32)
        self._object, self._otf = (np.zeros(self.model.otf.shape, np.complex64) for _ in range(2))
        self.sample_weights = np.zeros(window, np.float32)
        self._gaps = GapTreatment(self.taper)

    @property
    def grid(self) -> Grid:
        """Grid of the model and of every frame."""
        return self.model.grid

    def otf(self, grid: Grid, m_dpt: float) -> Spectrum:
        """Return the OTF of an eye with mean sphere M on a grid, complex64 (rows, cols//2 + 1)."""
        return self.interpolated_otf.on_grid(grid.shape, grid.n, transform(self.geometry, m_dpt))

    @cached_property
    def _shading(self) -> Shading:
        return Shading(self.model)

    def frame(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Linear:
        """Return the frame on this model's samples, and set `sample_weights`: good share times taper, per sample."""
        frame = self._preparer(counts, dark, defects)
        self._gaps = GapTreatment(self.taper)
        if frame.has_gaps:
            gap = frame.good < MIN_GOOD
            wide = ndimage.binary_opening(gap, np.ones((WIDE_SAMPLES, WIDE_SAMPLES), np.bool_))
            near = np.minimum(1, ndimage.distance_transform_edt(~wide) / RAMP_SAMPLES) if wide.any() else 1.0
            weights = (self.taper * (0.5 - 0.5 * np.cos(np.pi * near))).astype(np.float32)
            self._gaps = GapTreatment(weights, gap & ~wide)
        np.multiply(frame.good, self._gaps.weights, out=self.sample_weights)
        return frame

    def fit_smooth(self, frame: Linear, otf: Spectrum) -> float:
        """Set the model's OTF, fit the smooth object (before the blur) to the frame, and keep its spectrum.

        The spectrum is used by `residual`. Return the mean level in DN.
        """
        self.model.refocus(otf)
        self._shading.refocus()
        smooth = np.zeros(self.grid.shape, np.float32)
        level, stray = self._shading.fit(frame, smooth)
        self.set_smooth(frame, smooth, stray, otf)
        return level

    def set_smooth(self, frame: Linear, smooth: Image, stray: float, otf: Spectrum) -> None:
        """Set the smooth object (grid, before the blur by `otf`) that `residual` subtracts; `stray` is in DN.

        The detail of the frame is continued into narrow gaps.
        """
        self.model.otf, self._smooth = otf, smooth
        self._object = self.object_spectrum(smooth)
        if self._gaps.narrow is not None:
            self._fill_narrow_gaps(frame, stray, self._gaps.narrow)

    def object_spectrum(self, image: Image) -> Spectrum:
        """Return the spectrum of an object on the grid as a new array."""
        self.model.fft.space[:] = image
        return self.model.fft.forward().copy()

    def _fill_narrow_gaps(self, frame: Linear, stray: float, narrow: Mask) -> None:
        """Set the filling of the gaps to the detail around narrow gaps, continued into them; 0 elsewhere.

        Wide gaps are tapered like the window. A gap of zeros has an edge with power at every frequency, which would be
        attributed to the retina.
        """
        smooth = self.model.blur(self._smooth)[self.grid.slices] + np.float32(stray)
        known = (frame.good >= MIN_GOOD).astype(np.float32)
        detail = ndimage.gaussian_filter((frame.y - smooth) * known, FADE_SAMPLES)
        share = ndimage.gaussian_filter(known, FADE_SAMPLES)
        filling = (narrow * self._gaps.weights * detail / np.maximum(share, 0.1)).astype(np.float32)
        self._gaps = replace(self._gaps, filling=filling)

    def residual(self, frame: Linear, m_dpt: float) -> float:
        """Write the tapered spectrum of the frame minus its smooth part through the candidate's PSF to `fft.spectrum`.

        Return the constant stray light in DN.
        """
        return self.residual_of(frame, transform(self.geometry, m_dpt))[1]

    def residual_of(self, frame: Linear, stretch: Transform) -> tuple[float, float]:
        """Do as `residual` for the eye with this stretch of the PSF; return the scale of the smooth part and the stray
        light in DN.
        """
        grid = self.grid
        self.interpolated_otf.on_grid(grid.shape, grid.n, stretch, self._otf)
        smooth = self._seen(self._object)
        level, stray = flat_fit(kernels.flat_fit_sums(frame.y, smooth, frame.good))
        kernels.residual(frame.y, smooth, self._gaps.known_weights, level, stray, (0, 0), self.fft.space)
        if self._gaps.filling is not None:
            self.fft.space += self._gaps.filling
        self.fft.forward()
        return level, stray

    def spectrum_of(self, part: Spectrum) -> Spectrum:
        """Return the tapered spectrum of an object (its spectrum on the grid) through the PSF of the last residual."""
        np.multiply(self._seen(part), self._gaps.known_weights, out=self.fft.space)
        return self.fft.forward()

    def _seen(self, part: Spectrum) -> Image:
        """Return the blurred object in the window, in the units of the FFT without its scale."""
        fft = self.model.fft
        np.multiply(part, self._otf, out=fft.spectrum)
        return fft.inverse()[self.grid.slices]

    def negative_log_likelihood(self, frame: Linear, noise_dn2: float, m_dpt: float, part: Band) -> float:
        """Return the negative log likelihood (nats, up to a constant) of the candidate M over `part` of the band.

        `frame` must come from `self.frame`, and `fit_smooth` must have been called with it. R is the spectrum of
        `residual`. Write |H|^2 + SMEAR times its ring mean to `part.power`, |R|^2 to `part.energy`, and R to
        `fft.spectrum`.
        """
        self.residual(frame, m_dpt)
        stretch = transform(self.geometry, m_dpt)
        otf = self.interpolated_otf.at_frequencies(part.rows, part.cols, part.share, self.grid.n, stretch)
        return fused_kernels.negative_log_likelihood(
            self.fft.spectrum,
            otf,
            part.where,
            part.ring,
            noise_dn2,
            SMEAR,
            REPETITIONS,
            self._levels,
            part.energy,
            part.power,
        )

    def noise(self, frame: Linear) -> Noise:
        """Return the noise of a sample of the frame.

        It comes from the sensor's gain, or, if that is unknown, from the quarter of the frequencies with the lowest
        |H|^2 in the spectrum of the last `residual`.
        """
        stopband_power = np.abs(self.fft.spectrum.ravel()[self.bands.stopband].astype(np.complex128)) ** 2
        weight = float(np.vdot(self.sample_weights, self.sample_weights))
        return Noise.of(self.sensor, self.grid.n, float(np.median(stopband_power)) / np.log(2) / weight, frame.mean_dn)


def noise_power(noise: Noise, frame: Linear, weights: Image) -> float:
    """Return the noise power per frequency of the DFT of a frame's window with weights, in DN^2."""
    squared = np.square(weights, dtype=np.float64)
    return max(noise.per_dn * float((squared * frame.y).sum()) + noise.floor_dn2 * float(squared.sum()), 1e-20)
