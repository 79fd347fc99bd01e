"""Total-variation deconvolution for a scene without a known edge and an inaccurate PSF.

The objective and the ADMM iteration are those of `tv` (two real FFT pairs a round, 60 rounds). Light may come from
beyond the sensor, the residual is dominated by the model error, and the field gives no brightness scale. Therefore
every weight is relative to the frame itself:

* Variance of a sample: v (0.8 y/mean + 0.2), as in `Noise` for an unknown gain; v cancels.
* tau = misfit x |h|, the rms of the unexplained part after correlation with the PSF, so that shot noise, a wrong PSF
  and stray light count alike. The misfit is a median, computed again every RENEWED rounds.
* Start: the evidence solution on the sensor, zero beyond it; light is added there only as far as the data require. From
  an evenly bright start 120 rounds converge less far than 60 from this one.

KAPPA and RHO are 1 by construction. Halving or doubling KAPPA moves the three dlmd recordings (60 rounds: 18.32, 22.32,
15.26 dB) by -0.09, -0.38, -0.43 and -0.12, +0.23, +0.15 dB; RHO by +0.03, +0.01, -0.10 and -0.08, -0.26, 0.00; STIFF by
-0.11, -0.05, -0.03 and -0.04, -0.16, -0.08; RENEWED by 0.00, 0.00, +0.02 and -0.04, +0.04, -0.03; 80 or 120 rounds
instead of 60 by -0.01, -0.13, +0.14 and -0.02, -0.22, +0.12. All of these are at least as good as 100 rounds of
LenslessPiCam. On nine simulated scenes (PSF off by 1 % in scale, by a blur of 1.2 px, or of another depth), which were
not used for tuning, the best of KAPPA 1/4, 1/2, 1, 2, 4 is 1/2, 1 or 2 for seven, and 1 costs at most 0.3 dB against
it. The other two are a smooth retina under the dlmd PSF: the best value is 4, and 1 costs 1.9 dB; in the instrument the
field of a retina is known, and `variation` is used.
"""

from dataclasses import replace

import numpy as np

from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics
from device.recon.solvers.tv import TotalVariation
from device.values import Calibration

KAPPA = 1.0  # of tau
RHO = 1.0  # stiffness of z and w, in units of a typical weight times the mean |H|^2
STIFF = 0.03  # stiffness of v, in units of a typical weight
RENEWED = 10  # rounds for which a tau is kept
SAMPLES = 20_000  # of the window, for the median
MAD = 0.6745  # the median absolute value of a unit normal


class OpenFieldTotalVariation(TotalVariation):
    """Total-variation solver for an unknown field, 60 rounds by default; the caller may stop after any round."""

    rounds = 60

    def __init__(self, model: Model, calibration: Calibration, planner: Planner) -> None:
        sensor = replace(calibration.sensor, gain_e_per_dn=None, read_noise_e=None)  # no photon weights
        super().__init__(model, replace(calibration, sensor=sensor), planner)
        self._psf_norm = _norm(model)
        self._stride = max(1, model.grid.window[0] * model.grid.window[1] // SAMPLES) | 1
        self._typical = 1.0
        self._done = 0

    def start(self, frame: Linear) -> None:
        """Compute the evidence solution on the sensor, zero beyond it; then weights, penalties and a first tau."""
        super().start(frame)
        noise = self.detail.noise
        grid = self.model.grid
        self._typical = 1 / noise.variance_dn2(frame.mean_dn)
        self.rho = RHO * self._typical * self._psf_norm**2
        self.stiffness = STIFF * self._typical
        self.blurred[grid.slices] = frame.y  # weights from the frame, not from the start with its zeros
        fused_kernels.data_weights(
            self.blurred,
            self._y,
            frame.good,
            noise.per_dn,
            noise.floor_dn2,
            self.stiffness,
            grid.at,
            self._weighted,
            self._inverse,
        )
        self._darken_beyond_the_sensor()
        self._blur()
        self._done = 0
        self._renew_tau()

    def _darken_beyond_the_sensor(self) -> None:
        rows, cols = self.model.grid.slices
        self.x[: rows.start] = 0
        self.x[rows.stop :] = 0
        self.x[:, : cols.start] = 0
        self.x[:, cols.stop :] = 0

    def _renew_tau(self) -> None:
        misfit = self.misfit()
        self.tau = self.given.get("tau", KAPPA * misfit * self._psf_norm * self._typical**0.5)
        self._add_diagnostics(Diagnostics(regularisation={"tau": self.tau, "misfit": misfit}))

    def misfit(self) -> float:
        """Return a robust rms (median / MAD) of the residual in units of each sample's noise: 1 for noise alone."""
        blurred = self.blurred[self.model.grid.slices].reshape(-1)[:: self._stride]
        y = self._y.reshape(-1)[:: self._stride]
        good = self._good.reshape(-1)[:: self._stride]
        noise = self.detail.noise
        noise_dn = np.sqrt(noise.per_dn * np.maximum(y, 0) + noise.floor_dn2)
        return float(np.median(np.abs(y - blurred) * good / noise_dn)) / MAD

    def step(self) -> None:
        """Run one ADMM round (two real FFT pairs); compute tau again every RENEWED rounds."""
        if self._done and self._done % RENEWED == 0:
            self._renew_tau()
        super().step()
        self._done += 1


def _norm(model: Model) -> float:
    """Return the 2-norm of the PSF on the grid, from the OTF by Parseval: 1/sqrt(n) for n equally bright samples."""
    power = np.abs(model.otf) ** 2
    full = 2 * power.sum(dtype=np.float64) - power[:, 0].sum(dtype=np.float64)
    if model.grid.shape[1] % 2 == 0:
        full -= power[:, -1].sum(dtype=np.float64)
    return float(np.sqrt(full / model.grid.size))
