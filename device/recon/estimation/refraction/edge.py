"""Field edge in the likelihood of a refraction: diameter, centre and width of the lit disc, estimated with the eye.

A cropped sensor shows only the inner part of the PSF of a point at the field edge, so that a displaced edge looks like
another refraction: 0.1 deg of diameter cost 0.4 dpt at 33.4 deg and 0.75 dpt at 45 deg on an IMX296. So the edge of the
calibration is a prior only. For each candidate eye T the likelihood of `estimator` is minimised over the edge e:

    E(T) = min over d of  sum over f of  log S + |R_T - sum_k d_k R_T,k|^2 / S  +  |(e + d - e_expected) / PRIOR|^2

R_T,k is the tapered spectrum of the derivative of smooth part times edge with respect to e_k (radius, centre, width),
blurred by the candidate's PSF. e_expected is the calibrated edge, or the one of the picture (`lit_disc`); PRIOR is
sqrt(2) sd of the edge. The minimum over d is a generalised least-squares step with the spectrum S of detail and noise
as covariance; the steps are repeated with the smooth part fitted within the edge found (NUMERICS.md 7.5).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.background import SensorPolynomial, without
from device.recon.estimation.noise import Noise
from device.recon.estimation.psf_warp import InterpolatedOtf, Stretch
from device.recon.estimation.refraction.field import Edge, EdgePrior, FieldEdge, LitField
from device.recon.estimation.refraction.likelihood import (
    Band,
    BandLikelihood,
    RefractionLikelihood,
    Residual,
    SampledFrame,
    SmoothPart,
    band_likelihood,
    noise_power,
)
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.grid import Pair
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear
from device.values import Calibration, Geometry, Image

SAMPLE_UM = 24.0
SPOT_SAMPLE_UM = 20.0  # behind lenslets, whose spots are in focus: samples of 27 um bias M by 0.02 dpt
PARAMETERS = 4
ROUNDING_STEP = 7  # every such row and column shows whether counts are whole numbers

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class EdgeModel:
    """Linear model of the edge around one candidate: spectra of the derivatives by k parameters, (k, K).

    `weighted` is the conjugate of `moved` over the spectrum S; `matrix` half the information on the k parameters, that
    of the prior included.
    """

    moved: Spectrum
    weighted: Spectrum
    matrix: Floats


@dataclass(frozen=True)
class Candidate:
    """Likelihood of one candidate eye with its best edge.

    `nats` is the negative log likelihood (up to a constant) with the penalty of the edge, `terms` its part of each
    frequency, (K,), `levels` the level of the retina's detail of each ring, `step` the best change of the first
    parameters of the edge in samples.
    """

    nats: float
    terms: Floats
    levels: Floats
    step: Floats


class EdgeLikelihood:
    """Negative log likelihood of an eye with an unknown field edge, for one calibration and one sensor shape.

    An eye is an array of M, or of M, J0 and J45, in dpt. With `edge_is_known` the calibrated edge is kept. It holds the
    state of the `frame` of the last `start`: the edge, the `noise` of a sample, the light `dithered_dn` from which on
    it dithers the rounding of the counts (0 for a frame that is not rounded), and the smooth part of the last
    `fit_smooth`. `field` fits the smooth part of any frame on these samples, `band` holds the frequencies.
    """

    def __init__(
        self,
        calibration: Calibration,
        geometry: Geometry,
        stretch: Stretch,
        shape: Pair,
        planner: Planner,
        index: int,
        edge_is_known: bool,
    ) -> None:
        assert calibration.field_deg is not None
        self._count = 0 if edge_is_known else PARAMETERS
        diameter_deg, width_deg = calibration.soft_edge_deg or (calibration.field_deg, None)
        wide = replace(calibration, field_deg=2 * EdgePrior(diameter_deg, width_deg, 1.0).largest_samples)
        otf = InterpolatedOtf(calibration.psfs[index])
        sample_um = SPOT_SAMPLE_UM if geometry.has_spots else SAMPLE_UM
        self.likelihood = RefractionLikelihood(wide, geometry, stretch, shape, planner, index, otf, sample_um)
        self.grid = self.likelihood.grid
        self.band: Band = self.likelihood.bands.whole
        self.prior = EdgePrior(diameter_deg, width_deg, geometry.px_per_deg / self.grid.n)
        self.edge = self.prior.calibrated
        self.field = LitField(self.grid, self.edge, self.prior.largest_samples)
        self._sampled: SampledFrame
        self._whole: Linear  # with its background
        self._uneven: SensorPolynomial | None = None
        self._smooth: SmoothPart
        self._moved_objects: list[Spectrum] = []
        self.noise = Noise(0.0, 1.0)
        self._is_rounded = False
        self.dithered_dn = 0.0
        self._noise_dn2 = 1.0

    @property
    def frame(self) -> Linear:
        """Frame of the last `start`, without the background that the last `fit_smooth` found."""
        return self._sampled.linear

    def start(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Linear:
        """Return the frame on this model's samples, and begin with the calibrated edge."""
        self._sampled = self.likelihood.frame(counts, dark, defects)
        self._whole = self._sampled.linear
        background = self.likelihood.background
        self._uneven = None if background.polynomial(self._whole) is None else background.highest
        self._is_rounded = _is_rounded(counts)
        self.expect(self.prior.calibrated)
        return self.frame

    def expect(self, edge: Edge) -> None:
        """Begin again with this edge, and centre the prior on it."""
        self.prior = self.prior.around(edge)
        self.edge = edge

    def set_noise(self, eye_dpt: Floats) -> None:
        """Set the noise from the sensor's gain, or from the residual of this candidate."""
        stretch = self.likelihood.stretch(*eye_dpt)
        residual = self.likelihood.residual(self._sampled, self._smooth, stretch)
        self.noise = self.likelihood.noise(self._sampled, residual)
        self._noise_dn2 = noise_power(self.noise, self._sampled)
        self.dithered_dn = self.noise.dithered_dn(self.grid.n) if self._is_rounded else 0.0

    def fit_smooth(self, eye_dpt: Floats) -> float:
        """Fit the smooth part within the present edge through the PSF of an eye; return its mean level in DN."""
        stretch = self.likelihood.stretch(*eye_dpt)
        otf = self.likelihood.interpolated_otf.on_grid(self.grid.shape, self.grid.n, stretch)
        smooth = self.field.fit(self._whole, otf, self.edge, self._uneven)
        self._sampled = replace(self._sampled, linear=without(self._whole, smooth.background))
        self._smooth = self.likelihood.smooth_part(self._sampled, smooth.image, otf, smooth.level_dn, smooth.stray_dn)
        self._moved_objects = [self.likelihood.object_spectrum(image) for image in smooth.derivatives]
        return smooth.level_dn

    def picture(self, eye_dpt: Floats, power: Image) -> Image:
        """Return the linear picture of the frame on the grid: smooth part of the last fit, and detail.

        The detail is the Wiener estimate from the tapered rest of the frame; `power` is its spectrum, (rows, cols//2 +
        1), in the units of the levels of the rings.
        """
        fft, grid, known = self.likelihood.model.fft, self.grid, self._sampled.known
        stretch = self.likelihood.stretch(*eye_dpt)
        otf = self.likelihood.interpolated_otf.on_grid(grid.shape, grid.n, stretch)
        np.multiply(self._smooth.spectrum, otf, out=fft.spectrum)
        rest = self.frame.y - fft.inverse()[grid.slices] / np.float32(grid.size)
        rest -= np.vdot(known, rest) / known.sum()
        fft.space[:] = 0
        fft.space[grid.slices] = rest * known
        filtered = fft.forward() * otf.conj() * (power / (power * np.abs(otf) ** 2 + np.float32(self._noise_dn2)))
        np.add(self._smooth.spectrum, filtered, out=fft.spectrum)
        return np.asarray(fft.inverse() / np.float32(grid.size))

    def __call__(self, eye_dpt: Floats, most: int = PARAMETERS) -> Candidate:
        """Return the negative log likelihood of an eye, minimised over the first `most` parameters of the edge."""
        rest, otf, residual = self._residual(eye_dpt)
        found = band_likelihood(rest, otf, self.band, self._noise_dn2)
        count = min(most, self._count)
        return self._minimised(rest, otf, self._edge_model(residual, found, count)) if count else _candidate(found)

    def edge_model(self, eye_dpt: Floats) -> EdgeModel | None:
        """Return the linear model of the edge around a candidate, for `near`; None for a known edge."""
        if not self._count:
            return None
        rest, otf, residual = self._residual(eye_dpt)
        return self._edge_model(residual, band_likelihood(rest, otf, self.band, self._noise_dn2), self._count)

    def near(self, eye_dpt: Floats, model: EdgeModel | None) -> Candidate:
        """Return the likelihood of an eye near the candidate of `model`, minimised over the edge of that model."""
        rest, otf, _ = self._residual(eye_dpt)
        if model is None:
            return _candidate(band_likelihood(rest, otf, self.band, self._noise_dn2))
        return self._minimised(rest, otf, model)

    def _residual(self, eye_dpt: Floats) -> tuple[Spectrum, Spectrum, Residual]:
        """Return residual and OTF at the band's frequencies, (K,), and the whole residual."""
        stretch = self.likelihood.stretch(*eye_dpt)
        residual = self.likelihood.residual(self._sampled, self._smooth, stretch)
        return *self.likelihood.at_band(residual, stretch), residual

    def _edge_model(self, residual: Residual, found: BandLikelihood, count: int) -> EdgeModel:
        """Return the linear model of the edge around the candidate of a residual, with its likelihood."""
        objects = self._moved_objects[:count]
        seen = (self.likelihood.spectrum_of(part, residual.otf, self._sampled) for part in objects)
        moved = np.stack([np.float32(residual.level) * spectrum.ravel()[self.band.where] for spectrum in seen])
        weighted = np.asarray(moved.conj() / found.model, np.complex64)
        matrix = (weighted @ moved.T).real.astype(np.float64) + np.diag(self.prior.precision[:count])
        return EdgeModel(moved, weighted, matrix)

    def _minimised(self, rest: Spectrum, otf: Spectrum, model: EdgeModel) -> Candidate:
        count = len(model.moved)
        penalty = self.prior.precision[:count]
        away = (self.edge.vector - self.prior.expected.vector)[:count]
        step = np.linalg.solve(model.matrix, (model.weighted @ rest).real - penalty * away).astype(np.float64)
        found = band_likelihood(rest - step.astype(np.float32) @ model.moved, otf, self.band, self._noise_dn2)
        candidate = _candidate(found)
        return replace(candidate, nats=candidate.nats + float(penalty @ (away + step) ** 2), step=step)

    def move_edge(self, step: Floats) -> float:
        """Move the first parameters of the edge by `step` (samples), within their range; return the largest change.

        That of a soft edge is divided by its softness.
        """
        before = self.edge
        self.edge = self.prior.moved(self.edge, step)
        return float(np.abs(self.edge.vector - before.vector).max()) / self.prior.softness

    def field_edge(self, model: EdgeModel | None) -> FieldEdge:
        """Return the present edge in degrees; the sd of its diameter is from `matrix`, half the information."""
        radius_sd_samples = 0.0 if model is None else float(np.linalg.inv(model.matrix)[0, 0] ** 0.5)
        return self.prior.in_degrees(self.edge, radius_sd_samples)


def _candidate(found: BandLikelihood) -> Candidate:
    terms = (np.log(found.model) + found.energy / found.model).astype(np.float64)
    return Candidate(found.nats, terms, found.levels, np.zeros(0))


def _is_rounded(counts: Pixels) -> bool:
    """Return True for counts as a converter gives them: whole numbers, also in a float frame with missing pixels."""
    if counts.dtype.kind == "u":
        return True
    some = counts[::ROUNDING_STEP, ::ROUNDING_STEP]
    some = some[np.isfinite(some)]
    return some.size > 0 and bool((some == np.rint(some)).all())
