"""The eye's refraction from the frame itself: the stretch of the stored PSF under which the frame is most likely.

Defocus scales the PSF about its axis (see `warp`). The fine structure of |H|^2 scales inversely; it modulates the power
spectrum of every frame. The estimate of M minimises the negative log likelihood E (optics.md 6.2):

    E(M) = sum over f of  log S + |R|^2 / S,    S = g_ring |H_M|^2 + s2

|H_M|^2 includes SMEAR times its ring mean. R is the frame minus its smooth part, blurred by the *candidate's* PSF. If
the smooth part is blurred by a fixed PSF, the estimate is biased by one third towards that PSF. The smooth part itself
(`shading`) is fitted with the stored PSF for the coarse search, and with the PSF found by it for the fine search.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.errors import SettingError
from device.recon import kernels, sweeps
from device.recon.choose import flat_fit
from device.recon.defects import DefectFinder
from device.recon.evidence import band
from device.recon.geometry import Grid, Pair, support_radius_px
from device.recon.kernels import Pixels, Places
from device.recon.model import dirichlet, field_radius_px, taper, tight_model
from device.recon.noise import Noise
from device.recon.plan import Planner, RealFft, Spectrum
from device.recon.prepare import LEAST_GOOD, Linear, Preparer
from device.recon.shading import Shading
from device.recon.warp import ElasticOtf, transform
from device.values import Calibration, Image, Mask

SAMPLE_UM = 20.0  # as coarse as the caustic's band (3 to 22 cycles/mm) permits
TAPER_UM = 300.0
FADE_SAMPLES = 2.0  # over which detail is continued into a narrow gap
WIDE_SAMPLES, RAMP_SAMPLES = 5, 10  # a gap that holds a square so wide is tapered over so many samples
SPAN_DPT = 9.0
RINGS, TURNS = 20, 4
SMEAR = 0.1  # of a ring's mean |H|^2: what the tapered window mixes in from neighbouring frequencies
FRINGES = 0.2  # cycles by which the finest speckle moves from one candidate of the coarse search to the next
LEAST_NATS = 150.0  # best candidate over the median one: another head's PSF gives 110, retinas at 10 ke- 1200 and more
LEAST_FREQUENCIES = 500
UPPER_BIAS_DPT = 0.2  # by which the upper half of the band differs from all of it where both are right
DISAGREED_DPT = 3.0  # beyond, the evidence has more than one valley, and the stored PSF is the safer guess
SD_PER_MISSING_DPT = 0.4  # times the missing share: saturated frames of 11 eyes were off by 1.4 sd (rms) without it
GAP_FITS = 3  # of the smooth part: what fills a narrow gap pulls the answer towards the PSF that it was fitted with
SD_FACTOR = 1.4  # neighbouring frequencies are not independent; with it 23 frames had z scores of rms 1.0


@dataclass(frozen=True)
class Refraction:
    """Refraction estimate: mean sphere M in dpt (positive: myopia), its standard deviation, and the search curve.

    The report has the opposite sign (spectacle correction). `psf_scale` is the scale of the stored PSF; `curve` holds
    (M in dpt, negative log likelihood) of every coarse candidate, sorted; `nats` is the median minus the minimum over
    the coarse grid. `noise_sd_dpt` is the sd from the noise, with SD_PER_MISSING_DPT times the missing share in
    quadrature; `disagreement_dpt` is |M of the upper half of the band - M of the full band|.
    """

    sphere_dpt: float
    psf_scale: float
    noise_sd_dpt: float
    nats: float
    curve: tuple[tuple[float, float], ...]
    disagreement_dpt: float = 0.0

    @property
    def sd_dpt(self) -> float:
        """Return the standard deviation of M in dpt: `noise_sd_dpt` and the excess disagreement in quadrature.

        The excess is `disagreement_dpt` above UPPER_BIAS_DPT; it detects a false minimum of the likelihood.
        """
        more_dpt = max(0.0, self.disagreement_dpt - UPPER_BIAS_DPT)
        return float(np.hypot(self.noise_sd_dpt, more_dpt))

    @property
    def in_doubt(self) -> bool:
        """Whether the stored PSF is to be used: M is not significant, or the two parts of the band disagree.

        That is |M| < max(0.12 dpt, 2 `noise_sd_dpt`), or `disagreement_dpt` > DISAGREED_DPT.
        """
        return abs(self.sphere_dpt) < max(0.12, 2 * self.noise_sd_dpt) or self.disagreement_dpt > DISAGREED_DPT


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
        rows, cols = down[where // across.size], across[where % across.size]
        share = (dirichlet(rows, n) * dirichlet(cols, n)).astype(np.float32)
        scratch = (np.zeros(where.size, np.float32) for _ in range(2))
        return cls(where, ring, rows, cols, share, *scratch)


def can_refract(calibration: Calibration) -> bool:
    """Whether the refraction can be estimated: geometry and field radius are known."""
    return calibration.geometry is not None and np.isfinite(field_radius_px(calibration))


class Refractor:
    """Planned once for a calibration and a sensor shape; then asked for the refraction behind each frame."""

    def __init__(
        self, calibration: Calibration, shape: Pair, planner: Planner, index: int, elastic: ElasticOtf | None = None
    ) -> None:
        geometry = calibration.geometry
        if geometry is None or not can_refract(calibration):
            raise SettingError("a refraction needs the head's geometry and field", "Give --head HEAD.toml.")
        psf = calibration.psfs[index]
        self.geometry, self.sensor = geometry, calibration.sensor
        self.elastic = ElasticOtf(psf) if elastic is None else elastic
        n = max(1, min(round(SAMPLE_UM / geometry.pitch_um), min(shape) // 16))
        self.model = tight_model(calibration, shape, n, planner, index)
        self.grid = self.model.grid
        self.shading = Shading(self.model)
        self.preparer = Preparer(calibration, self.grid)
        self._calibration, self._shape, self._index = calibration, shape, index
        self.fft: RealFft = planner.plan(self.grid.window)
        self.taper = taper(self.grid.window, min(0.5, TAPER_UM / (geometry.pitch_um * n * min(self.grid.window))))
        self._choose_frequencies()
        self._spread = float((self.taper**4).sum() * self.taper.size / (self.taper**2).sum() ** 2)
        lever = self.high / n * 2 * support_radius_px(psf) * geometry.scale_per_dpt
        self.step_dpt = float(np.clip(FRINGES / lever, 0.1, 2.0))
        self._smooth: Image = np.zeros(self.grid.shape, np.float32)
        self._object, self._otf = (np.zeros(self.model.otf.shape, np.complex64) for _ in range(2))
        self.seen = np.zeros(self.grid.window, np.float32)
        self._weights: Image = self.taper
        self._faded: Image | None = None
        self._narrow: Mask | None = None

    def _choose_frequencies(self) -> None:
        """The band that carries the speckle, in rings; and the quarter of all frequencies that carries least."""
        window, n = self.grid.window, self.grid.n
        rows, cols = np.fft.fftfreq(window[0])[:, None], np.fft.rfftfreq(window[1])[None]
        frequency = np.hypot(rows, cols)
        power = np.abs(self.elastic.on(window, n, np.eye(2)).astype(np.complex128)) ** 2
        self.low, self.high = band(frequency, power, min(window))
        self.band = Band.of(window, self.low, self.high, n)
        middle = float(np.median(frequency.ravel()[self.band.where])) if self.band.where.size else self.high
        self._upper = Band.of(window, middle, self.high, n)
        self._silent = np.flatnonzero(power <= np.quantile(power, 0.25))
        self._levels = np.zeros(RINGS)

    @cached_property
    def defects(self) -> DefectFinder:
        """The defect search, for callers of `find` that have no `defects` of their own."""
        return DefectFinder(self._calibration, self._shape, self._index)

    def find(self, counts: Pixels, dark: Pixels | None = None, defects: Places | None = None) -> Refraction | None:
        """Estimate the refraction of a frame (rows, cols) in counts; None if it cannot be determined.

        None: the band has fewer than LEAST_FREQUENCIES, the fitted level is not positive, the minimum is less than
        LEAST_NATS below the median, or |M| >= SPAN_DPT. `defects` (flat indices) are left out, see `DefectFinder`.
        """
        if self.band.where.size < LEAST_FREQUENCIES:
            return None
        frame = self.frame(counts, dark, defects)
        if not self.fit_smooth(frame, self.model.stored) > 0:
            return None
        self.residual(frame, 0.0)
        noise = self.noise_power(frame)
        coarse = Search(lambda m_dpt: self.unlikelihood(frame, noise, m_dpt, self.band))
        sphere_dpt = coarse.ladder(self.step_dpt)
        if coarse.relief < LEAST_NATS:
            return None
        sphere_dpt = coarse.walk(sphere_dpt, self.step_dpt / 2)
        for _ in range(GAP_FITS if frame.has_gaps else 1):
            self.fit_smooth(frame, self.otf(self.grid, sphere_dpt))
            fine = Search(lambda m_dpt: self.unlikelihood(frame, noise, m_dpt, self.band))
            for part in (2, 4):
                sphere_dpt = fine.walk(sphere_dpt, self.step_dpt / part)
        if abs(sphere_dpt) >= SPAN_DPT:
            return None
        vertex_dpt, bend = fine.parabola(sphere_dpt, self.step_dpt / 4)
        sd_dpt = min(SD_FACTOR * (self._spread / bend) ** 0.5, SPAN_DPT) if bend > 0 else SPAN_DPT
        sd_dpt = float(np.hypot(sd_dpt, SD_PER_MISSING_DPT * frame.missing))
        curve = tuple(sorted(coarse.known.items()))
        apart_dpt = abs(self._found_by_the_upper_half(frame, noise, sphere_dpt) - vertex_dpt)
        return Refraction(vertex_dpt, self.scale(vertex_dpt), sd_dpt, coarse.relief, curve, apart_dpt)

    def frame(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Linear:
        """The frame on this model's samples; `seen` becomes the weights of its samples."""
        frame = self.preparer(counts, dark, defects)
        self._weights, self._faded, self._narrow = self.taper, None, None
        if frame.has_gaps:
            gap = frame.good < LEAST_GOOD
            wide = ndimage.binary_opening(gap, np.ones((WIDE_SAMPLES, WIDE_SAMPLES), np.bool_))
            near = np.minimum(1, ndimage.distance_transform_edt(~wide) / RAMP_SAMPLES) if wide.any() else 1.0
            self._weights = (self.taper * (0.5 - 0.5 * np.cos(np.pi * near))).astype(np.float32)
            self._narrow = gap & ~wide
        np.multiply(frame.good, self._weights, out=self.seen)
        return frame

    def _found_by_the_upper_half(self, frame: Linear, noise: float, sphere_dpt: float) -> float:
        """The minimum downhill from a candidate when only the upper half of the band is asked."""
        upper = Search(lambda m_dpt: self.unlikelihood(frame, noise, m_dpt, self._upper))
        for part in (1, 2):
            sphere_dpt = upper.walk(sphere_dpt, self.step_dpt / part)
        return upper.parabola(sphere_dpt, self.step_dpt / 2)[0]

    def scale(self, m_dpt: float) -> float:
        """Return the scale factor of the PSF for mean sphere M in dpt: 1 for M = 0, below 1 for myopia."""
        return 1 - self.geometry.scale_per_dpt * m_dpt

    def otf(self, grid: Grid, m_dpt: float) -> Spectrum:
        """The OTF on a grid as an eye with mean sphere M makes it."""
        return self.elastic.on(grid.shape, grid.n, transform(self.geometry, m_dpt))

    def fit_smooth(self, frame: Linear, otf: Spectrum) -> float:
        """Set the model's OTF, fit the smooth object (before the blur) to the frame, and keep its spectrum.

        The spectrum is used by `residual`. Return the mean level in DN.
        """
        self.model.refocus(otf)
        self.shading.refocus()
        level, stray = self.shading.fit(frame, self._smooth)
        self.model.fft.space[:] = self._smooth
        self._object[:] = self.model.fft.forward()
        if self._narrow is not None:
            self._fill_narrow_gaps(frame, stray, self._narrow)
        return level

    def _fill_narrow_gaps(self, frame: Linear, stray: float, narrow: Mask) -> None:
        """Into `_faded`: the detail around narrow gaps, continued into them; 0 elsewhere.

        Wide gaps are tapered like the window. A gap of zeros has an edge, and an edge has power at every frequency: it
        would count as the retina's.
        """
        smooth = self.model.blur(self._smooth)[self.grid.slices] + np.float32(stray)
        known = (frame.good >= LEAST_GOOD).astype(np.float32)
        detail = ndimage.gaussian_filter((frame.y - smooth) * known, FADE_SAMPLES)
        share = ndimage.gaussian_filter(known, FADE_SAMPLES)
        self._faded = (narrow * self._weights * detail / np.maximum(share, 0.1)).astype(np.float32)

    def residual(self, frame: Linear, m_dpt: float) -> float:
        """Into the window's spectrum: the frame minus its smooth part through the candidate's PSF, tapered.

        Return the constant stray light in DN.
        """
        model, grid = self.model, self.grid
        stretch = transform(self.geometry, m_dpt)
        self.elastic.on(grid.shape, grid.n, stretch, self._otf)
        np.multiply(self._object, self._otf, out=model.fft.spectrum)
        smooth = model.fft.inverse()[grid.slices]
        level, stray = flat_fit(kernels.dots(frame.y, smooth, frame.good))
        weights = self._weights if self._narrow is None else self._weights * ~self._narrow
        kernels.residual(frame.y, smooth, weights, level, stray, (0, 0), self.fft.space)
        if self._faded is not None:
            self.fft.space += self._faded
        self.fft.forward()
        return stray

    def unlikelihood(self, frame: Linear, noise_dn2: float, m_dpt: float, part: Band) -> float:
        """Return the negative log likelihood (nats, up to a constant) of the candidate M over `part` of the band.

        Write |H|^2 + SMEAR times its ring mean to `part.power`, and |R|^2 to `part.energy`.
        """
        self.residual(frame, m_dpt)
        stretch = transform(self.geometry, m_dpt)
        otf = self.elastic.at(part.rows, part.cols, part.share, self.grid.n, stretch)
        return sweeps.unlikelihood(
            self.fft.spectrum,
            otf,
            part.where,
            part.ring,
            noise_dn2,
            SMEAR,
            TURNS,
            self._levels,
            part.energy,
            part.power,
        )

    def noise_power(self, frame: Linear) -> float:
        """Return the noise power per frequency of the tapered window's DFT in DN^2.

        It comes from the sensor's gain, or from the quarter of the frequencies with the lowest |H|^2.
        """
        silent = np.abs(self.fft.spectrum.ravel()[self._silent].astype(np.complex128)) ** 2
        weight = float(np.vdot(self.seen, self.seen))
        noise = Noise.of(self.sensor, self.grid.n, float(np.median(silent)) / np.log(2) / weight, frame.mean_dn)
        lit = float(np.einsum("ij,ij,ij->", frame.y, self.seen, self.seen))
        return max(noise.per_dn * lit + noise.floor_dn2 * weight, 1e-20)


class Search:
    """One-dimensional minimum search over M; the value of each candidate is computed once."""

    def __init__(self, value: Callable[[float], float]) -> None:
        self._value = value
        self.known: dict[float, float] = {}
        self.relief = 0.0

    def __call__(self, m_dpt: float) -> float:
        """Return the negative log likelihood of the candidate M, clipped to the span."""
        m_dpt = round(float(np.clip(m_dpt, -SPAN_DPT, SPAN_DPT)), 4)
        if m_dpt not in self.known:
            self.known[m_dpt] = self._value(m_dpt)
        return self.known[m_dpt]

    def ladder(self, step_dpt: float) -> float:
        """Evaluate an equidistant grid over +-SPAN_DPT, and return its point with the lowest value.

        `relief` becomes the median minus the minimum of these values, in nats.
        """
        rungs = np.linspace(-SPAN_DPT, SPAN_DPT, 2 * max(int(np.ceil(SPAN_DPT / step_dpt)), 2) + 1)
        values = [self(m_dpt) for m_dpt in rungs]
        self.relief = float(np.median(values) - min(values))
        return float(rungs[int(np.argmin(values))])

    def walk(self, m_dpt: float, step_dpt: float) -> float:
        """Downhill in equal steps until both neighbours are higher."""
        while True:
            least = min((m_dpt - step_dpt, m_dpt, m_dpt + step_dpt), key=self)
            if least == m_dpt or abs(least) >= SPAN_DPT:
                return float(np.clip(least, -SPAN_DPT, SPAN_DPT))
            m_dpt = least

    def parabola(self, m_dpt: float, step_dpt: float) -> tuple[float, float]:
        """The vertex through three candidates around a minimum, and the second derivative there; 0 if there is none."""
        left, middle, right = (self(m_dpt + k * step_dpt) for k in (-1, 0, 1))
        second = left - 2 * middle + right
        if second <= 0 or abs(m_dpt) + step_dpt > SPAN_DPT:
            return m_dpt, max(second, 0.0) / step_dpt**2
        return m_dpt + 0.5 * (left - right) / second * step_dpt, second / step_dpt**2
