"""Likelihood of an eye's refraction given one frame: the model that `estimator` searches over M.

E(M) is defined in `estimator`. One object holds the plans of one calibration and sensor shape. What is found of a frame
is passed on as values, from `frame` by `fit_smooth` and `residual` to the likelihood.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.background import Background
from device.recon.estimation.noise import Noise
from device.recon.estimation.parameter_selection import flat_fit
from device.recon.estimation.power_law_prior import band
from device.recon.estimation.psf_warp import InterpolatedOtf, Stretch, Transform
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

    `where`: flat index into the window's rfft spectrum. `ring`: 0 to RINGS - 1; `rings`: their number up to the last
    one with a frequency. `rows`, `cols`: frequency in cycles per sample. `share`: transfer of the n x n binning.
    """

    where: NDArray[np.int64]
    ring: NDArray[np.int64]
    rings: int
    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    share: Image

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
        return cls(where, ring, int(ring.max(initial=0)) + 1, rows, cols, share)


@dataclass(frozen=True)
class SearchBands:
    """Frequencies of the search: the band `whole` with the fine structure of |H|^2.

    `low` and `high` limit the band, cycles per sample. `stopband` holds the flat indices into the window's rfft
    spectrum of the quarter with the lowest |H|^2.
    """

    low: float
    high: float
    whole: Band
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
        return cls(low, high, whole, np.flatnonzero(power <= np.quantile(power, 0.25)))


@dataclass(frozen=True)
class SampledFrame:
    """A frame on the model's samples with their weights; each array has the window's shape.

    `taper` is the window's, which also falls to 0 at wide gaps; `weights` the good share of each sample times it;
    `known` the taper, 0 in the narrow gaps, which `narrow` marks (None for a frame without gaps).
    """

    linear: Linear
    taper: Image
    weights: Image
    known: Image
    narrow: Mask | None = None


@dataclass(frozen=True)
class SmoothPart:
    """Smooth part of a frame's object before the blur, as residuals subtract it.

    `spectrum`: that of the object on the grid; `level_dn`: its mean level. `filling`: detail of the frame continued
    into its narrow gaps, of the window's shape; None without such gaps.
    """

    spectrum: Spectrum
    level_dn: float
    filling: Image | None = None


@dataclass(frozen=True)
class Residual:
    """Tapered spectrum of a frame minus its smooth part through a candidate's PSF.

    `spectrum` is the array of the FFT: it holds until the next transform. `otf` is the candidate's on the grid: it
    holds until the next residual. `level` is the scale of the smooth part, `stray_dn` the constant stray light.
    """

    spectrum: Spectrum
    otf: Spectrum
    level: float
    stray_dn: float


@dataclass(frozen=True)
class BandLikelihood:
    """Negative log likelihood of a residual over a band, under S = g q + s2 with the best level g of each ring.

    `nats` is the likelihood up to a constant, `levels` holds g, (rings,). For each frequency, (K,): `energy` is |R|^2,
    `power` is q (|H|^2 + SMEAR times its ring mean), `model` is S.
    """

    nats: float
    levels: NDArray[np.float64]
    energy: Image
    power: Image
    model: Image


def band_likelihood(rest: Spectrum, otf: Spectrum, band: Band, noise_dn2: float) -> BandLikelihood:
    """Return the likelihood of a residual `rest` through a PSF `otf`, both (K,), for the noise s2 of a frequency."""
    levels = np.zeros(band.rings)
    energy = np.empty(rest.size, np.float32)
    power = np.empty(rest.size, np.float32)
    nats = fused_kernels.negative_log_likelihood(
        rest, otf, band.ring, noise_dn2, SMEAR, REPETITIONS, levels, energy, power
    )
    model = np.asarray(power * levels[band.ring] + noise_dn2, np.float32)
    return BandLikelihood(nats, levels, energy, power, model)


class RefractionLikelihood:
    """Negative log likelihood of a mean sphere M for PSF `index` of one calibration, and one sensor shape.

    `interpolated_otf` is that of the PSF; likelihoods with other fields of view share it, as it holds up to 32 MB.
    """

    def __init__(
        self,
        calibration: Calibration,
        geometry: Geometry,
        stretch: Stretch,
        shape: Pair,
        planner: Planner,
        index: int,
        interpolated_otf: InterpolatedOtf,
        sample_um: float = SAMPLE_UM,
    ) -> None:
        self.geometry, self.stretch = geometry, stretch
        self.sensor = calibration.sensor
        self.interpolated_otf = interpolated_otf
        n = max(1, min(round(sample_um / geometry.pitch_um), min(shape) // 16))
        self.model = tight_model(calibration, shape, n, planner, index)
        self._preparer = Preprocessor(calibration, self.grid)
        window = self.grid.window
        self.fft: RealFft = planner.plan(window)
        self.taper = taper(window, min(0.5, TAPER_UM / (geometry.pitch_um * n * min(window))))
        self.bands = SearchBands.of(window, n, self.interpolated_otf)
        self._otf = np.zeros(self.model.otf.shape, np.complex64)

    @property
    def grid(self) -> Grid:
        """Grid of the model and of every frame."""
        return self.model.grid

    def otf(self, grid: Grid, m_dpt: float) -> Spectrum:
        """Return the OTF of an eye with mean sphere M on a grid, complex64 (rows, cols//2 + 1)."""
        return self.interpolated_otf.on_grid(grid.shape, grid.n, self.stretch(m_dpt))

    @cached_property
    def _shading(self) -> Shading:
        return Shading(self.model)

    @cached_property
    def background(self) -> Background:
        """Search for an uneven background in frames on these samples."""
        return Background(self._shading, self.grid.n)

    def frame(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> SampledFrame:
        """Return the frame on this model's samples, with the weight of each."""
        linear = self._preparer(counts, dark, defects)
        if not linear.has_gaps:
            return SampledFrame(linear, self.taper, linear.good * self.taper, self.taper)
        gap = linear.good < MIN_GOOD
        wide = ndimage.binary_opening(gap, np.ones((WIDE_SAMPLES, WIDE_SAMPLES), np.bool_))
        near = np.minimum(1, ndimage.distance_transform_edt(~wide) / RAMP_SAMPLES) if wide.any() else 1.0
        taper = (self.taper * (0.5 - 0.5 * np.cos(np.pi * near))).astype(np.float32)
        narrow = gap & ~wide
        return SampledFrame(linear, taper, linear.good * taper, taper * ~narrow, narrow)

    def fit_smooth(self, frame: SampledFrame, otf: Spectrum) -> SmoothPart:
        """Return the smooth part that fits a frame through an OTF on the grid."""
        self.model.refocus(otf)
        self._shading.refocus()
        smooth = np.zeros(self.grid.shape, np.float32)
        level, stray = self._shading.fit(frame.linear, smooth)
        return self.smooth_part(frame, smooth, otf, level, stray)

    def smooth_part(
        self, frame: SampledFrame, smooth: Image, otf: Spectrum, level_dn: float, stray_dn: float
    ) -> SmoothPart:
        """Return a smooth object (grid, before the blur by `otf`) as residuals of the frame subtract it.

        `stray_dn` is the stray light beside it. The detail of the frame is continued into its narrow gaps.
        """
        spectrum = self.object_spectrum(smooth)
        if frame.narrow is None:
            return SmoothPart(spectrum, level_dn)
        self.model.otf = otf
        seen = self.model.blur(smooth)[self.grid.slices] + np.float32(stray_dn)
        return SmoothPart(spectrum, level_dn, _filling(frame, seen, frame.narrow))

    def object_spectrum(self, image: Image) -> Spectrum:
        """Return the spectrum of an object on the grid as a new array."""
        self.model.fft.space[:] = image
        return self.model.fft.forward().copy()

    def residual(self, frame: SampledFrame, smooth: SmoothPart, stretch: Transform) -> Residual:
        """Return what the smooth part through the PSF of an eye, with this stretch, leaves of a frame."""
        grid = self.grid
        linear = frame.linear
        otf = self.interpolated_otf.on_grid(grid.shape, grid.n, stretch, self._otf)
        seen = self._seen(smooth.spectrum, otf)
        level, stray_dn = flat_fit(kernels.flat_fit_sums(linear.y, seen, linear.good))
        kernels.residual(linear.y, seen, frame.known, level, stray_dn, (0, 0), self.fft.space)
        if smooth.filling is not None:
            self.fft.space += smooth.filling
        return Residual(self.fft.forward(), otf, level, stray_dn)

    def spectrum_of(self, part: Spectrum, otf: Spectrum, frame: SampledFrame) -> Spectrum:
        """Return the tapered spectrum of an object (its spectrum on the grid) through an OTF on the grid.

        It is the array of the FFT.
        """
        np.multiply(self._seen(part, otf), frame.known, out=self.fft.space)
        return self.fft.forward()

    def _seen(self, part: Spectrum, otf: Spectrum) -> Image:
        """Return the blurred object in the window, in the units of the FFT without its scale."""
        fft = self.model.fft
        np.multiply(part, otf, out=fft.spectrum)
        return fft.inverse()[self.grid.slices]

    def at_band(self, residual: Residual, stretch: Transform) -> tuple[Spectrum, Spectrum]:
        """Return the residual and the OTF of its eye at the frequencies of the band, (K,) each."""
        band = self.bands.whole
        otf = self.interpolated_otf.at_frequencies(band.rows, band.cols, band.share, self.grid.n, stretch)
        return residual.spectrum.ravel()[band.where], otf

    def of_sphere(self, frame: SampledFrame, smooth: SmoothPart, noise_dn2: float, m_dpt: float) -> BandLikelihood:
        """Return the likelihood of the candidate M; `noise_dn2` is the noise of a frequency."""
        stretch = self.stretch(m_dpt)
        rest, otf = self.at_band(self.residual(frame, smooth, stretch), stretch)
        return band_likelihood(rest, otf, self.bands.whole, noise_dn2)

    def noise(self, frame: SampledFrame, residual: Residual) -> Noise:
        """Return the noise of a sample of the frame.

        It comes from the sensor's gain, or, if that is unknown, from the quarter of the frequencies with the lowest
        |H|^2 in the spectrum of a residual.
        """
        stopband_power = np.abs(residual.spectrum.ravel()[self.bands.stopband].astype(np.complex128)) ** 2
        weight = float(np.vdot(frame.weights, frame.weights))
        seen_dn2 = float(np.median(stopband_power)) / np.log(2) / weight
        return Noise.of(self.sensor, self.grid.n, seen_dn2, frame.linear.mean_dn)


def _filling(frame: SampledFrame, smooth: Image, narrow: Mask) -> Image:
    """Return the detail around narrow gaps, continued into them, 0 elsewhere; `smooth`: smooth part in the window.

    Wide gaps are tapered like the window. A gap of zeros has an edge with power at every frequency, which would be
    attributed to the retina.
    """
    known = (frame.linear.good >= MIN_GOOD).astype(np.float32)
    detail = ndimage.gaussian_filter((frame.linear.y - smooth) * known, FADE_SAMPLES)
    share = ndimage.gaussian_filter(known, FADE_SAMPLES)
    filling: Image = (narrow * frame.taper * detail / np.maximum(share, 0.1)).astype(np.float32)
    return filling


def noise_power(noise: Noise, frame: SampledFrame) -> float:
    """Return the noise power per frequency of the DFT of a frame's window with its weights, in DN^2."""
    squared = np.square(frame.weights, dtype=np.float64)
    return max(noise.per_dn * float((squared * frame.linear.y).sum()) + noise.floor_dn2 * float(squared.sum()), 1e-20)
