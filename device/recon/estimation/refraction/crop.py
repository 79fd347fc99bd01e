"""Crop-aware refinement of a refraction: Gauss-Newton steps on the likelihood of the frame itself, not of its spectrum.

The lit field is smaller than the blurred frame, so that the frame holds more samples than the retina has unknowns, and
the wrong PSF leaves a residual that no retina explains. The spectrum alone (`likelihood`) does not hold
this. With the model of `crop_model`, the residual r = y - C h_T * s and the derivatives D of the expected
frame at the posterior mean s + a t with respect to T = (M, J0, J45), a step is

    (D' K^-1 D)^-1 (D' K^-1 r - b)

b is the mean of the score D' K^-1 r over frames that are drawn from the fit itself: the noise, and the smooth part that
is fitted before the detail, give the score of the true eye a mean that is not 0 (NUMERICS.md 7.7). It is computed, at
the cost of four more solves, only behind a diffuser whose blurred field is larger than the window (areas); elsewhere it
is small, and b = 0. The field edge is held. Symbols: `crop_model`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.refraction.burst import BurstFrame, frame_steps
from device.recon.estimation.refraction.crop_model import COVARIANCE_ITERATIONS, CropModel, Fit
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.estimation.refraction.pupil import dark_rim
from device.recon.model.fft_plans import Planner

VARIANCE_PER_MISFIT = 1.7  # of the misfit: the detail takes up a quarter of the residual; the rest is correlated
BIAS_SHARE = 0.7  # of b: sd by its own error, as b is taken at the fit and not at the true retina
MAX_STEPS = 12  # 2 to 4 are usual
BIAS_STEPS = 2  # first steps, for which the bias of a noise-free frame is computed
FULL_STEPS = 3  # first steps; later ones are halved: some frames overshoot by a factor of two
NOISE_DRAWS = 2  # for the bias by noise: their scatter adds 3 % to the sd
SETTLED_SDS = 0.2
MAX_MISFIT = 1.2
LARGEST_STEP_DPT = 0.7
MAX_RIM_SD = 18.0  # clean frames up to 9, pupils that hide 2 % at 500 electrons from 34 on

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Refined:
    """Eye (M, J0, J45) in dpt as wavefront, and the misfit; `covariance` is (D' K^-1 D)^-1 of the first step, dpt^2.

    `misfit` is the squared residual over its noise per sample: below MAX_MISFIT where the model explains the frame.
    `bias_dpt` is what b takes from a step; 0 where b is not computed. `rim_sd` is `pupil.dark_rim` of the last fit,
    `model_sd_dpt` the part of the sds by the model.
    """

    eye_dpt: Floats
    covariance: Floats
    bias_dpt: Floats
    misfit: float
    has_settled: bool
    rim_sd: float
    model_sd_dpt: float

    @property
    def is_explained(self) -> bool:
        """True if the model explains the frame."""
        return self.misfit < MAX_MISFIT

    @property
    def is_whole(self) -> bool:
        """True if no part of the rim of the PSF is dark."""
        return self.rim_sd < MAX_RIM_SD

    @property
    def sds_dpt(self) -> Floats:
        """Standard deviations of M, J0 and J45, (3,)."""
        by_residual = VARIANCE_PER_MISFIT * self.misfit * np.diag(self.covariance)
        return np.asarray(np.sqrt(by_residual + self.model_sd_dpt**2 + (BIAS_SHARE * self.bias_dpt) ** 2))


class CropRefinement:
    """Refinement of the eyes that an `EdgeLikelihood` has found, on the same grid, for a PSF with this radius.

    `model_sd_dpt`: sd of each component by the model.
    """

    def __init__(self, edges: EdgeLikelihood, planner: Planner, psf_radius_px: float, model_sd_dpt: float) -> None:
        self._edges, self._psf_radius_px, self._model_sd_dpt = edges, psf_radius_px, model_sd_dpt
        self._model = CropModel(edges, planner, psf_radius_px)

    def steps(self, eye_dpt: Floats, edge: FieldEdge, frames: Sequence[BurstFrame]) -> Floats:
        """Return the step of each frame of a burst from an eye, as `frame_steps` does."""
        return frame_steps(self._edges, self._model, eye_dpt, edge, frames)

    def __call__(self, eye_dpt: Floats) -> Refined:
        """Return the refinement of an eye (M, J0, J45) of the frame that `edges` was started with."""
        light = self._edges.frame.y
        model = self._model
        detail = None
        model.start(eye_dpt)
        has_bias = model.seen_share < 1 and not self._edges.likelihood.geometry.has_spots
        without_noise = np.zeros(3)
        by_noise = np.zeros(3)
        for done in range(MAX_STEPS):
            model.focus(eye_dpt)
            fit = model.fit(light, detail)
            detail = fit.detail
            if has_bias and done < BIAS_STEPS:
                without_noise = model.fit(fit.expected, detail).score
            if done == 0:
                covariance = model.covariance(fit.derivatives)
            if has_bias and done == 0:
                by_noise = self._score_of_noise(fit)
                # Of J0 and J45 it is small by symmetry (0.3 sd on four frames), and draws would mostly scatter.
                by_noise[1:] = 0
            bias_dpt = covariance @ (without_noise + by_noise)
            step = covariance @ fit.score - bias_dpt
            if done >= FULL_STEPS:
                step = step / 2
            eye_dpt = eye_dpt + np.clip(step, -LARGEST_STEP_DPT, LARGEST_STEP_DPT)
            sds_dpt = np.sqrt(np.diag(covariance) + self._model_sd_dpt**2)
            has_settled = bool((np.abs(step) < SETTLED_SDS * sds_dpt).all())
            if has_settled:
                break
        self._edges.fit_smooth(eye_dpt)
        rim_sd = dark_rim(self._edges, eye_dpt, fit, self._psf_radius_px)
        misfit = model.misfit(light, fit)
        return Refined(eye_dpt, covariance, bias_dpt, misfit, has_settled, rim_sd, self._model_sd_dpt)

    def _score_of_noise(self, fit: Fit) -> Floats:
        """Return the mean score (3,) that the sensor's noise adds to that of the expected frame of a fit.

        The fit is linear, and its score a quadratic form of the frame: over both signs of a noise it grows by the score
        of the noise alone. Steps by 20 iterations differ from that by up to 0.003 dpt, by 200 by 0.0002.
        """
        noise = self._edges.noise
        random = np.random.default_rng(0)
        total = np.zeros(3)
        sd_dn = np.sqrt(noise.per_dn * np.maximum(fit.expected, 0) + noise.floor_dn2).astype(np.float32)
        for _ in range(NOISE_DRAWS):
            noise_dn = random.standard_normal(sd_dn.shape, np.float32) * sd_dn
            total += self._model.fit(noise_dn, None, COVARIANCE_ITERATIONS).score
        return total / NOISE_DRAWS
