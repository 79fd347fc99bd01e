"""PSF match test for an eye of any refraction: does a frame come through the stored PSF (calibration monitor).

The power spectrum of a frame is that of the retina times |H|^2. The retina's power is independent of the fine structure
of |H|^2: in a narrow ring of frequencies the frame's power follows |H|^2 in proportion to its mean if the PSF is right.

    score = sum of cov(|Y|^2, |H|^2) / sum of g var(|H|^2)    over rings, each weighted by its information

is near 1 for the right PSF and near 0 for a wrong one. Y is the tapered frame itself: a residual from which a picture
blurred by the stored PSF was subtracted contains the structure of that PSF, and raises the score of any PSF to about
one half. NUMERICS.md 8.3.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.assessment.field_edge import FieldEdgeFit
from device.recon.estimation.refraction.estimator import MIN_FREQUENCIES, RefractionEstimator, Search
from device.recon.estimation.refraction.likelihood import BandLikelihood, noise_power
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Linear
from device.values import Image

NEAR = 5  # samples: side of the square of neighbours whose mean fills a missing sample
RING = 250  # frequencies: narrower than the fringes of the field's edge, and enough for a covariance

Between = Callable[[], None]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PsfMatchResult:
    """Score of one frame, the eye's mean sphere M, and the displacement of the field.

    The field is None where it has no sharp edge, in whose frames it cannot be found (OPTICS.md 4.9).

    Attributes
    ----------
    score
        Match of frame and PSF, 1 for the PSF of the frame.
    sd
        Standard deviation of the score.
    m_dpt
        Mean sphere M in dpt, positive for myopia; the report states the correction, of the other sign.
    field_offset_deg
        Displacement of the illuminated field's centre from the sensor's in degrees (down, right).
    field_radius_change_ratio
        Relative excess of its radius over the calibrated one.
    """

    score: float
    sd: float
    m_dpt: float
    field_offset_deg: tuple[float, float] | None
    field_radius_change_ratio: float | None

    @property
    def upper_limit(self) -> float:
        """Upper limit of the score, two standard deviations above it; a dim frame must not count as a wrong PSF."""
        return self.score + 2 * self.sd


class PsfMatchTest:
    """PSF match test of the frames of one head.

    Parameters
    ----------
    refractor
        Estimator of the refraction, whose plans are used.
    has_edge
        True: the lit field has a sharp edge.
    """

    def __init__(self, refractor: RefractionEstimator, has_edge: bool = True) -> None:
        self._refractor = refractor
        self._likelihood = refractor.likelihood
        bands = self._likelihood.bands
        band = bands.whole
        order = np.argsort(np.hypot(band.rows, band.cols))
        self._rings = np.array_split(order, max(1, order.size // RING))
        self._rim: FieldEdgeFit | None = None
        if has_edge:
            self._rim = FieldEdgeFit(self._likelihood.model, bands.low, bands.high, self._likelihood.taper)

    def __call__(self, counts: Pixels, dark: Pixels | None, between: Between = lambda: None) -> PsfMatchResult | None:
        """Return the result for one frame.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        between
            Function that is called every few milliseconds; its exceptions end the test.

        Returns
        -------
        PsfMatchResult or None
            None without light, or with too few usable frequencies.
        """
        refractor = self._refractor
        likelihood = self._likelihood
        if likelihood.bands.whole.where.size < MIN_FREQUENCIES:
            return None
        frame = likelihood.frame(counts, dark, refractor.defects(counts, dark))
        smooth = likelihood.fit_smooth(frame, likelihood.model.stored)
        if not smooth.level_dn > 0:
            return None
        relaxed = likelihood.residual(frame, smooth, likelihood.stretch(0.0))
        noise = noise_power(likelihood.noise(frame, relaxed), frame)

        def found(m_dpt: float) -> BandLikelihood:
            between()
            return likelihood.of_sphere(frame, smooth, noise, m_dpt)

        search = Search(lambda m_dpt: found(m_dpt).nats)
        m_dpt = search.descend(search.grid_search(refractor.step_dpt), refractor.step_dpt / 4)
        stray_dn = likelihood.residual(frame, smooth, likelihood.stretch(m_dpt)).stray_dn
        score, sd = self._score(_filled(frame.linear) - np.float32(stray_dn), found(m_dpt).power, noise)
        if self._rim is None:
            return PsfMatchResult(score, sd, m_dpt, None, None)
        likelihood.model.refocus(likelihood.otf(likelihood.grid, m_dpt))
        edge = self._rim.fit(frame.linear.y, between)
        per_deg = refractor.geometry.px_per_deg / likelihood.grid.n
        return PsfMatchResult(
            score,
            sd,
            m_dpt,
            (edge.offset_samples[0] / per_deg, edge.offset_samples[1] / per_deg),
            edge.radius_change_ratio,
        )

    def _score(self, y: Image, psf_power: Image, noise: float) -> tuple[float, float]:
        band = self._likelihood.bands.whole
        fft = self._likelihood.fft
        np.multiply(y, self._likelihood.taper, out=fft.space)
        seen = np.abs(fft.forward().ravel()[band.where].astype(np.complex128)) ** 2
        power = psf_power.astype(np.float64)
        found = expected = certainty = 0.0
        for ring in self._rings:
            energy = seen[ring]
            speckle = power[ring] - power[ring].mean()
            mean = float(energy.mean())
            level = max(mean - noise, 0.0) / float(power[ring].mean())
            spread = float(speckle @ speckle) / mean**2
            found += float(speckle @ energy) / mean**2
            expected += level * spread
            certainty += spread
        if expected <= 0:
            return 0.0, float("inf")
        return found / expected, certainty**0.5 / expected


def _filled(frame: Linear) -> Image:
    """Return the frame with its missing samples (`good` 0) set to the mean of the known samples in a square of NEAR."""
    holes = frame.good == 0
    if not holes.any():
        return frame.y
    there = np.where(holes, np.float32(0), np.float32(1))
    near = ndimage.uniform_filter(frame.y * there, NEAR) / np.maximum(ndimage.uniform_filter(there, NEAR), 1e-3)
    filled: Image = np.where(holes, near, frame.y)
    return filled
