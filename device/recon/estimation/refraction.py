"""Estimation of the eye's refraction from the frame: the scale of the stored PSF with the highest likelihood.

Defocus scales the PSF about its axis (see `psf_warp`). The fine structure of |H|^2 scales inversely; it modulates the
power spectrum of every frame. The estimate of M minimises the negative log likelihood E (`refraction_likelihood`,
NUMERICS.md 7.1):

    E(M) = sum over f of  log S + |R|^2 / S,    S = g_ring |H_M|^2 + s2

|H_M|^2 includes SMEAR times its ring mean. R is the frame minus its smooth part, blurred by the *candidate's* PSF. If
the smooth part is blurred by a fixed PSF, the estimate is biased by one third towards that PSF. The smooth part itself
(`shading`) is fitted with the stored PSF for the coarse search, and with the PSF found by it for the fine search.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from device.errors import SettingError
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.refraction_likelihood import RefractionLikelihood
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import Grid, Pair, support_radius_px
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear
from device.values import Calibration

SPAN_DPT = 9.0
FRINGES = 0.2  # cycles by which the finest structure of |H|^2 moves between two candidates of the coarse search
LEAST_NATS = 150.0  # median minus minimum: the PSF of another head gives 110, retinas at 10 ke- at least 1200
LEAST_FREQUENCIES = 500
UPPER_BIAS_DPT = 0.2  # typical difference between the upper half of the band and the whole band
DISAGREED_DPT = 3.0  # beyond, the likelihood has several minima, and the stored PSF is used
SD_PER_MISSING_DPT = 0.4  # times the missing share: saturated frames of 11 eyes were off by 1.4 sd (rms) without it
GAP_FITS = 3  # of the smooth part: the filling of a narrow gap biases M towards the PSF of the fit
SD_FACTOR = 1.4  # for the correlation of neighbouring frequencies; with it 23 frames have z scores of rms 1.0


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
        """Standard deviation of M in dpt: `noise_sd_dpt` and the excess disagreement in quadrature.

        The excess is `disagreement_dpt` above UPPER_BIAS_DPT; it detects a false minimum of the likelihood.
        """
        more_dpt = max(0.0, self.disagreement_dpt - UPPER_BIAS_DPT)
        return float(np.hypot(self.noise_sd_dpt, more_dpt))

    @property
    def in_doubt(self) -> bool:
        """True if the stored PSF is to be used: M is not significant, or the two parts of the band disagree.

        That is |M| < max(0.12 dpt, 2 `noise_sd_dpt`), or `disagreement_dpt` > DISAGREED_DPT.
        """
        return abs(self.sphere_dpt) < max(0.12, 2 * self.noise_sd_dpt) or self.disagreement_dpt > DISAGREED_DPT


def can_estimate_refraction(calibration: Calibration) -> bool:
    """Return True if the refraction can be estimated: geometry and field radius are known."""
    return calibration.geometry is not None and np.isfinite(field_radius_px(calibration))


class RefractionEstimator:
    """Estimator of the refraction, planned for one calibration and one sensor shape.

    SettingError if geometry or field are unknown. `index` selects the stored PSF.
    """

    def __init__(self, calibration: Calibration, shape: Pair, planner: Planner, index: int) -> None:
        geometry = calibration.geometry
        if geometry is None or not can_estimate_refraction(calibration):
            raise SettingError("a refraction needs the head's geometry and field", "Give --head HEAD.toml.")
        self.geometry = geometry
        self.likelihood = RefractionLikelihood(calibration, geometry, shape, planner, index)
        self._calibration, self._shape, self._index = calibration, shape, index
        taper, bands = self.likelihood.taper, self.likelihood.bands
        self._spread = float((taper**4).sum() * taper.size / (taper**2).sum() ** 2)
        reach_px = support_radius_px(calibration.psfs[index])
        lever = bands.high / self.likelihood.grid.n * 2 * reach_px * geometry.scale_per_dpt
        self.step_dpt = float(np.clip(FRINGES / lever, 0.1, 2.0))

    @cached_property
    def defects(self) -> DefectFinder:
        """Defect search of this calibration, for callers of `find` without a search of their own."""
        return DefectFinder(self._calibration, self._shape, self._index)

    def find(self, counts: Pixels, dark: Pixels | None = None, defects: Places | None = None) -> Refraction | None:
        """Estimate the refraction of a frame (rows, cols) in counts; None if it cannot be determined.

        None: the band has fewer than LEAST_FREQUENCIES, the fitted level is not positive, the minimum is less than
        LEAST_NATS below the median, or |M| >= SPAN_DPT. `defects` (flat indices) are left out, see `DefectFinder`.
        """
        likelihood = self.likelihood
        if likelihood.bands.whole.where.size < LEAST_FREQUENCIES:
            return None
        frame = likelihood.frame(counts, dark, defects)
        if not likelihood.fit_smooth(frame, likelihood.model.stored) > 0:
            return None
        likelihood.residual(frame, 0.0)
        noise = likelihood.noise_power(frame)
        coarse = Search(lambda m_dpt: likelihood.negative_log_likelihood(frame, noise, m_dpt, likelihood.bands.whole))
        sphere_dpt = coarse.grid_search(self.step_dpt)
        if coarse.depth_nats < LEAST_NATS:
            return None
        sphere_dpt = coarse.descend(sphere_dpt, self.step_dpt / 2)
        for _ in range(GAP_FITS if frame.has_gaps else 1):
            likelihood.fit_smooth(frame, likelihood.otf(likelihood.grid, sphere_dpt))
            fine = Search(lambda m_dpt: likelihood.negative_log_likelihood(frame, noise, m_dpt, likelihood.bands.whole))
            for part in (2, 4):
                sphere_dpt = fine.descend(sphere_dpt, self.step_dpt / part)
        if abs(sphere_dpt) >= SPAN_DPT:
            return None
        vertex_dpt, curvature = fine.fit_parabola(sphere_dpt, self.step_dpt / 4)
        sd_dpt = min(SD_FACTOR * (self._spread / curvature) ** 0.5, SPAN_DPT) if curvature > 0 else SPAN_DPT
        sd_dpt = float(np.hypot(sd_dpt, SD_PER_MISSING_DPT * frame.missing))
        curve = tuple(sorted(coarse.known.items()))
        disagreement_dpt = abs(self._minimum_of_upper_band(frame, noise, sphere_dpt) - vertex_dpt)
        return Refraction(vertex_dpt, self.scale(vertex_dpt), sd_dpt, coarse.depth_nats, curve, disagreement_dpt)

    def _minimum_of_upper_band(self, frame: Linear, noise: float, sphere_dpt: float) -> float:
        """Return the minimum of the likelihood of the upper half of the band, in dpt, downhill from `sphere_dpt`."""
        likelihood = self.likelihood
        upper = Search(lambda m_dpt: likelihood.negative_log_likelihood(frame, noise, m_dpt, likelihood.bands.upper))
        for part in (1, 2):
            sphere_dpt = upper.descend(sphere_dpt, self.step_dpt / part)
        return upper.fit_parabola(sphere_dpt, self.step_dpt / 2)[0]

    def scale(self, m_dpt: float) -> float:
        """Return the scale factor of the PSF for mean sphere M in dpt: 1 for M = 0, below 1 for myopia."""
        return 1 - self.geometry.scale_per_dpt * m_dpt

    def otf(self, grid: Grid, m_dpt: float) -> Spectrum:
        """Return the OTF of an eye with mean sphere M on a grid, complex64 (rows, cols//2 + 1)."""
        return self.likelihood.otf(grid, m_dpt)


class Search:
    """One-dimensional search over M for the minimum of `value` (in nats), computed once for each candidate."""

    def __init__(self, value: Callable[[float], float]) -> None:
        self._value = value
        self.known: dict[float, float] = {}
        self.depth_nats = 0.0

    def __call__(self, m_dpt: float) -> float:
        """Return the value of the candidate M, which is first clipped to +-SPAN_DPT and rounded to 0.0001 dpt."""
        m_dpt = round(float(np.clip(m_dpt, -SPAN_DPT, SPAN_DPT)), 4)
        if m_dpt not in self.known:
            self.known[m_dpt] = self._value(m_dpt)
        return self.known[m_dpt]

    def grid_search(self, step_dpt: float) -> float:
        """Evaluate equidistant candidates over +-SPAN_DPT, at most `step_dpt` apart, and return the one of least value.

        `depth_nats` becomes the median minus the minimum of these values, in nats.
        """
        grid_dpt = np.linspace(-SPAN_DPT, SPAN_DPT, 2 * max(int(np.ceil(SPAN_DPT / step_dpt)), 2) + 1)
        values = [self(m_dpt) for m_dpt in grid_dpt]
        self.depth_nats = float(np.median(values) - min(values))
        return float(grid_dpt[int(np.argmin(values))])

    def descend(self, m_dpt: float, step_dpt: float) -> float:
        """Return the next local minimum in dpt, downhill from `m_dpt` in steps of `step_dpt`, within +-SPAN_DPT."""
        while True:
            least = min((m_dpt - step_dpt, m_dpt, m_dpt + step_dpt), key=self)
            if least == m_dpt or abs(least) >= SPAN_DPT:
                return float(np.clip(least, -SPAN_DPT, SPAN_DPT))
            m_dpt = least

    def fit_parabola(self, m_dpt: float, step_dpt: float) -> tuple[float, float]:
        """Return the vertex (dpt) of the parabola through m_dpt and m_dpt +- step_dpt, and its second derivative.

        Without a minimum, or beyond SPAN_DPT, the vertex is `m_dpt`; the derivative is at least 0, in nats/dpt^2.
        """
        left, middle, right = (self(m_dpt + k * step_dpt) for k in (-1, 0, 1))
        second = left - 2 * middle + right
        if second <= 0 or abs(m_dpt) + step_dpt > SPAN_DPT:
            return m_dpt, max(second, 0.0) / step_dpt**2
        return m_dpt + 0.5 * (left - right) / second * step_dpt, second / step_dpt**2
