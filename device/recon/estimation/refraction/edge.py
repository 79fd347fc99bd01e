"""Field edge in the likelihood of a refraction: diameter, centre and softness of the lit disc, estimated with the eye.

A cropped sensor shows only the inner part of the PSF of a point at the field edge, so that a displaced edge looks like
another refraction: 0.1 deg of diameter cost 0.4 dpt at 33.4 deg and 0.75 dpt at 45 deg on an IMX296. So the edge is not
taken from the calibration. For each candidate eye T the likelihood of `estimator` is minimised over the edge e:

    E(T) = min over d of  sum over f of  log S + |R_T - sum_k d_k R_T,k|^2 / S  +  |(e + d - e_calibrated) / PRIOR|^2

R_T,k is the tapered spectrum of the derivative of smooth part times edge with respect to e_k (radius, centre, width),
blurred by the candidate's PSF. PRIOR is sqrt(2) sd of the edge. The minimum over d is a generalised least-squares step
with the spectrum S of detail and noise as covariance; the steps are repeated with the smooth part fitted within the
edge found (NUMERICS.md 7.5).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.noise import Noise
from device.recon.estimation.psf_warp import transform
from device.recon.estimation.refraction.field import MARGIN_DEG, EdgePrior, FieldEdge, LitField
from device.recon.estimation.refraction.likelihood import REPETITIONS, SMEAR, Band, RefractionLikelihood, noise_power
from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.grid import Pair
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear
from device.values import Calibration, Geometry, Image

SAMPLE_UM = 24.0
PARAMETERS = 4
ROUNDING_STEP = 7  # every such row and column shows whether counts are whole numbers

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class EdgeModel:
    """Linear model of the edge around one candidate: spectra of the derivatives, (k, K), and their covariance model.

    `weighted` is the conjugate of `moved` over the spectrum S; `matrix` half the information on the k parameters.
    """

    moved: Spectrum
    weighted: Spectrum
    matrix: Floats


@dataclass(frozen=True)
class Candidate:
    """Likelihood of one candidate eye with its best edge.

    `nats` is the negative log likelihood (up to a constant) with the penalty of the edge, `terms` its part of each
    frequency, (K,), `step` the best change of the first parameters of the edge in samples.
    """

    nats: float
    terms: Floats
    step: Floats


class EdgeLikelihood:
    """Negative log likelihood of an eye with an unknown field edge, for one calibration and one sensor shape.

    An eye is an array of M, or of M, J0 and J45, in dpt. With `edge_is_known` the calibrated edge is kept. It holds the
    state of the `frame` of the last `start`: the edge, the `noise` of a sample, the light `dithered_dn` from which on
    it dithers the rounding of the counts (0 for a frame that is not rounded), and the smooth part of the last
    `fit_smooth`. `field` fits the smooth part of any frame on these samples, `band` holds the frequencies, `levels` the
    level of the retina's detail of each ring in the last likelihood.
    """

    def __init__(
        self,
        calibration: Calibration,
        geometry: Geometry,
        shape: Pair,
        planner: Planner,
        index: int,
        edge_is_known: bool,
    ) -> None:
        assert calibration.field_deg is not None
        self._count = 0 if edge_is_known else PARAMETERS
        wide = replace(calibration, field_deg=calibration.field_deg + 2 * MARGIN_DEG)
        self.likelihood = RefractionLikelihood(wide, geometry, shape, planner, index, SAMPLE_UM)
        self.grid = self.likelihood.grid
        self.band: Band = self.likelihood.bands.whole
        self.prior = EdgePrior(calibration.field_deg, geometry.px_per_deg / self.grid.n)
        self.edge = self.prior.calibrated
        self.field = LitField(self.grid, self.edge, self.prior.largest_samples)
        self._moved_objects: list[Spectrum] = []
        self._flat_places = np.arange(self.band.where.size)
        self.levels = np.zeros(int(self.band.ring.max(initial=0)) + 1)
        self.noise = Noise(0.0, 1.0)
        self._is_rounded = False
        self.dithered_dn = 0.0
        self._noise_dn2 = 1.0

    def start(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Linear:
        """Return the frame on this model's samples, and begin with the calibrated edge."""
        self.frame = self.likelihood.frame(counts, dark, defects)
        self._is_rounded = _is_rounded(counts)
        self.edge = self.prior.calibrated
        return self.frame

    def set_noise(self, eye_dpt: Floats) -> None:
        """Set the noise from the sensor's gain, or from the residual of this candidate."""
        self.likelihood.residual_of(self.frame, transform(self.likelihood.geometry, *eye_dpt))
        self.noise = self.likelihood.noise(self.frame)
        self._noise_dn2 = noise_power(self.noise, self.frame, self.likelihood.sample_weights)
        self.dithered_dn = self.noise.dithered_dn(self.grid.n) if self._is_rounded else 0.0

    def fit_smooth(self, eye_dpt: Floats) -> float:
        """Fit the smooth part within the present edge through the PSF of an eye; return its mean level in DN."""
        stretch = transform(self.likelihood.geometry, *eye_dpt)
        otf = self.likelihood.interpolated_otf.on_grid(self.grid.shape, self.grid.n, stretch)
        smooth = self.field.fit(self.frame, otf, self.edge)
        self.likelihood.set_smooth(self.frame, smooth.image, smooth.stray_dn, otf)
        self._moved_objects = [self.likelihood.object_spectrum(image) for image in smooth.derivatives]
        return smooth.level_dn

    def __call__(self, eye_dpt: Floats, most: int = PARAMETERS) -> Candidate:
        """Return the negative log likelihood of an eye, minimised over the first `most` parameters of the edge."""
        rest, otf, level = self._residual(eye_dpt)
        nats = self._nats(rest, otf)
        count = min(most, self._count)
        return self._minimised(rest, otf, self._edge_model(level, count)) if count else self._candidate(nats)

    def edge_model(self, eye_dpt: Floats) -> EdgeModel | None:
        """Return the linear model of the edge around a candidate, for `near`; None for a known edge."""
        rest, otf, level = self._residual(eye_dpt)
        self._nats(rest, otf)
        return self._edge_model(level, self._count) if self._count else None

    def near(self, eye_dpt: Floats, model: EdgeModel | None) -> Candidate:
        """Return the likelihood of an eye near the candidate of `model`, minimised over the edge of that model."""
        rest, otf, _ = self._residual(eye_dpt)
        return self._candidate(self._nats(rest, otf)) if model is None else self._minimised(rest, otf, model)

    def _residual(self, eye_dpt: Floats) -> tuple[Spectrum, Spectrum, float]:
        """Return residual and OTF at the band's frequencies, (K,), and the scale of the smooth part."""
        band = self.band
        likelihood = self.likelihood
        stretch = transform(likelihood.geometry, *eye_dpt)
        level, _ = likelihood.residual_of(self.frame, stretch)
        rest = likelihood.fft.spectrum.ravel()[band.where]
        otf = likelihood.interpolated_otf.at_frequencies(band.rows, band.cols, band.share, self.grid.n, stretch)
        return rest, otf, level

    def _edge_model(self, level: float, count: int) -> EdgeModel:
        """Return the linear model of the edge around the candidate of the last residual and likelihood."""
        spectra = (self.likelihood.spectrum_of(part).ravel()[self.band.where] for part in self._moved_objects[:count])
        moved = np.stack([np.float32(level) * spectrum for spectrum in spectra])
        weighted = np.asarray(moved.conj() / self._spectrum(), np.complex64)
        matrix = (weighted @ moved.T).real.astype(np.float64) + np.diag(self.prior.precision[:count])
        return EdgeModel(moved, weighted, matrix)

    def _minimised(self, rest: Spectrum, otf: Spectrum, model: EdgeModel) -> Candidate:
        count = len(model.moved)
        penalty = self.prior.precision[:count]
        away = (self.edge.vector - self.prior.calibrated.vector)[:count]
        step = np.linalg.solve(model.matrix, (model.weighted @ rest).real - penalty * away).astype(np.float64)
        nats = self._nats(rest - step.astype(np.float32) @ model.moved, otf)
        return replace(self._candidate(nats + float(penalty @ (away + step) ** 2)), step=step)

    def _nats(self, rest: Spectrum, otf: Spectrum) -> float:
        """Return the negative log likelihood of a residual; the levels, energies and powers of the band are kept."""
        band = self.band
        return fused_kernels.negative_log_likelihood(
            rest[None],
            otf,
            self._flat_places,
            band.ring,
            self._noise_dn2,
            SMEAR,
            REPETITIONS,
            self.levels,
            band.energy,
            band.power,
        )

    def _candidate(self, nats: float) -> Candidate:
        model = self._spectrum()
        return Candidate(nats, (np.log(model) + self.band.energy / model).astype(np.float64), np.zeros(0))

    def _spectrum(self) -> Image:
        """Return the model S of the last likelihood, (K,)."""
        return np.asarray(self.band.power * self.levels[self.band.ring] + self._noise_dn2, np.float32)

    def move_edge(self, step: Floats) -> float:
        """Move the first parameters of the edge by `step` (samples), within their range; return the largest change."""
        before = self.edge
        self.edge = self.prior.moved(self.edge, step)
        return float(np.abs(self.edge.vector - before.vector).max())

    def field_edge(self, model: EdgeModel | None) -> FieldEdge:
        """Return the present edge in degrees; the sd of its diameter is from `matrix`, half the information."""
        radius_sd_samples = 0.0 if model is None else float(np.linalg.inv(model.matrix)[0, 0] ** 0.5)
        return self.prior.in_degrees(self.edge, radius_sd_samples)


def _is_rounded(counts: Pixels) -> bool:
    """Return True for counts as a converter gives them: whole numbers, also in a float frame with missing pixels."""
    if counts.dtype.kind == "u":
        return True
    some = counts[::ROUNDING_STEP, ::ROUNDING_STEP]
    some = some[np.isfinite(some)]
    return some.size > 0 and bool((some == np.rint(some)).all())
