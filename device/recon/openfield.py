"""Total variation for a scene without a known edge: light comes from beyond the sensor, the PSF is only roughly right.

The objective is that of `variation`. What differs is what may be believed. The frame's misfit is mostly the model's
error, not photons, and no field says how bright a sample is, so every weight is relative to the frame itself:

* a sample's variance is v (0.8 y/mean + 0.2), the shape that `Noise` has where no gain is known; v cancels;
* tau = misfit x |h|: the rms that what the picture does not yet explain has once it is correlated with the PSF, so
  shot noise, a wrong PSF and light from nowhere count alike. The misfit is a median, renewed every RENEWED rounds;
* the start is the evidence solution where the sensor is, and dark beyond it: light is put there only if the frame
  insists. From an evenly bright start 120 rounds do not get as far as 60 from this one.

KAPPA and RHO are 1 by construction. Halving or doubling KAPPA moves the three dlmd recordings (60 rounds: 18.32, 22.32,
15.26 dB) by -0.09, -0.38, -0.43 and -0.12, +0.23, +0.15 dB; RHO by +0.03, +0.01, -0.10 and -0.08, -0.26, 0.00; STIFF by
-0.11, -0.05, -0.03 and -0.04, -0.16, -0.08; RENEWED by 0.00, 0.00, +0.02 and -0.04, +0.04, -0.03; 80 or 120 rounds
instead of 60 by -0.01, -0.13, +0.14 and -0.02, -0.22, +0.12. None of these falls behind 100 rounds of LenslessPiCam.
On nine simulated scenes (PSF off by 1 % in scale, by a blur of 1.2 px, or of another depth) that decided nothing, the
best of KAPPA 1/4, 1/2, 1, 2, 4 is 1/2, 1 or 2 for seven, and 1 costs at most 0.3 dB against it. The other two are a
smooth retina under the dlmd PSF: it asks for 4, and 1 costs 1.9 dB; its field is known in this house.
"""

from dataclasses import replace

import numpy as np

from device.recon import sweeps
from device.recon.model import Model
from device.recon.plan import Planner
from device.recon.prepare import Linear
from device.recon.variation import Variation
from device.values import Calibration

KAPPA = 1.0  # of tau
RHO = 1.0  # stiffness of z and w, in units of a typical weight times the mean |H|^2
STIFF = 0.03  # stiffness of v, in units of a typical weight
RENEWED = 10  # rounds for which a tau is kept
SAMPLES = 20_000  # of the window, for the median
MAD = 0.6745  # the median absolute value of a unit normal


class OpenField(Variation):
    """`variation` for an unknown field; slower to converge, so more rounds, and any of them may be the last."""

    rounds = 60

    def __init__(self, model: Model, calibration: Calibration, planner: Planner) -> None:
        sensor = replace(calibration.sensor, gain_e_per_dn=None, read_noise_e=None)  # see above
        super().__init__(model, replace(calibration, sensor=sensor), planner)
        self._psf_norm = _norm(model)
        self._stride = max(1, model.grid.window[0] * model.grid.window[1] // SAMPLES) | 1
        self._typical = 1.0
        self._done = 0

    def start(self, frame: Linear) -> None:
        """The evidence solution on the sensor, dark beyond it; then weights, stiffness and a first tau."""
        super().start(frame)
        noise, grid = self.noise, self.model.grid
        self._typical = 1 / noise.variance_dn2(frame.mean_dn)
        self.rho = RHO * self._typical * self._psf_norm**2
        self.stiffness = STIFF * self._typical
        self.blurred[grid.slices] = frame.y  # the frame says its own weights: the dark rim of this start does not
        sweeps.weigh(
            self.blurred, self._y, frame.good, noise.per_dn, noise.floor_dn2, self.stiffness, grid.at,
            self._weighted, self._inverse,
        )  # fmt: skip
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
        self.tau = KAPPA * misfit * self._psf_norm * self._typical**0.5
        self.facts |= {"tau": self.tau, "misfit": misfit}

    def misfit(self) -> float:
        """What is not explained, in units of each sample's noise: 1 where nothing but noise is left."""
        blurred = self.blurred[self.model.grid.slices].reshape(-1)[:: self._stride]
        y, good = self._y.reshape(-1)[:: self._stride], self._good.reshape(-1)[:: self._stride]
        noise_dn = np.sqrt(self.noise.per_dn * np.maximum(y, 0) + self.noise.floor_dn2)
        return float(np.median(np.abs(y - blurred) * good / noise_dn)) / MAD

    def step(self) -> None:
        """One round: two real FFT pairs."""
        if self._done and self._done % RENEWED == 0:
            self._renew_tau()
        super().step()
        self._done += 1


def _norm(model: Model) -> float:
    """The 2-norm of the PSF on the grid, by Parseval: one over the root of the number of spots that it spreads over."""
    power = np.abs(model.otf) ** 2
    full = 2 * power.sum(dtype=np.float64) - power[:, 0].sum(dtype=np.float64)
    if model.grid.shape[1] % 2 == 0:
        full -= power[:, -1].sum(dtype=np.float64)
    return float(np.sqrt(full / model.grid.size))
