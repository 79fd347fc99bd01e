"""The closed form: one FFT there, one filter, one FFT back. Paper, section "Algorithm", and its better prior.

    x = mask (a + F^-1[ conj(H) F(y - a flat - b) / (|H|^2 + mu R + delta) ])

With R = 1 and a = b = delta = 0 this is the paper's Tikhonov solution. With R = |D|^2 + floor it prefers smooth
pictures, as real ones are (power ~ 1/f^2). delta says how wrong the stored PSF may be: a relative error of the OTF acts
like noise that is proportional to the object, and without it a slightly wrong PSF, or light from beyond the sensor's
edge, paints large shadows. Taking the flat field out first removes most of what a cropped sensor would turn into
ringing, at no cost in FFTs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from device.errors import SettingError
from device.recon import kernels
from device.recon.choose import Energies, Sample, cross_validated, flat_fit
from device.recon.model import Model
from device.recon.prepare import Linear
from device.values import Image


@dataclass(frozen=True)
class Prior:
    """R(f) = slope |D|^2 + floor, the relative squared error of the PSF, and whether the flat field comes out first."""

    slope: float
    floor: float
    psf_error: float
    subtract_flat: bool


TIKHONOV = Prior(slope=0.0, floor=1.0, psf_error=0.0, subtract_flat=False)
# psf_error 0.1: on four simulated retinas 0.03 ... 0.3 lie within 0.015 of correlation of each other; on the
# DiffuserCam recordings, which run past the sensor's edge, below 0.03 the low frequencies are streaks.
GRADIENT = Prior(slope=1.0, floor=0.02, psf_error=0.1, subtract_flat=True)


class ClosedForm:
    """One planned closed-form solver; `solve` allocates nothing that grows with the image."""

    def __init__(self, model: Model, prior: Prior, mu: float | None = None) -> None:
        if mu is not None and not 0 < mu < float("inf"):
            raise SettingError(f"a weight mu of {mu} is not a positive number", "Leave mu out: the frame chooses it.")
        self.model, self.prior, self.mu = model, prior, mu
        self.sample = Sample.of(model)
        self.delta = prior.psf_error * self.sample.passband_power(model.bin)
        self._weights = prior.slope * self.sample.gradient + prior.floor

    def solve(self, frame: Linear, out: Image) -> dict[str, Any]:
        """Write the picture (rows, cols) of the grid into `out`; return what was chosen and the number that decided.

        Keys: `mu` (relative to |H|^2), `gcv`, `flat_dn`, `background_dn`, `noise_dn`, `residual` (rms over noise).
        """
        model, prior = self.model, self.prior
        level = background = 0.0
        if prior.subtract_flat:
            level, background = flat_fit(kernels.dots(frame.y, model.flat, frame.good))
        if model.window is not None:
            np.multiply(frame.good, model.window, out=frame.good)
        kernels.residual(frame.y, model.flat, frame.good, level, background, model.fft.space)
        spectrum = model.fft.forward()
        energies = self.sample.energies(spectrum)
        noise = self.sample.noise_variance(energies, model.size) ** 0.5
        mu, score = self._weight_of_the_prior(energies)
        misfit = self.sample.misfit(mu * self._weights + self.delta, energies, model.size)
        slope = np.float32(mu * prior.slope)
        floor = mu * prior.floor + self.delta
        rows, cols = model.row_gradient * slope, model.col_gradient * slope
        kernels.wiener(spectrum, model.otf, rows, cols, floor, 1 / model.size)
        kernels.add_flat(model.fft.inverse(), model.mask, level, model.box, out)
        return {
            "mu": mu, "gcv": score, "psf_error": prior.psf_error, "flat_dn": level, "background_dn": background,
            "noise_dn": noise, "residual": misfit / noise if noise > 0 else 0.0,
        }  # fmt: skip

    def _weight_of_the_prior(self, energies: Energies) -> tuple[float, float | None]:
        if self.mu is not None:
            return self.mu, None
        return cross_validated(self.sample.power, self._weights, self.delta, energies)
