"""The closed form: one FFT there, one filter, one FFT back. Paper, section "Algorithm", and its better prior.

    x = mask (a + F^-1[ conj(H) F(y - a flat - b) / (|H|^2 + mu R + delta / |D|^2) ])

With R = 1 and a = b = delta = 0 this is the paper's Tikhonov solution. With R = |D|^2 + floor it prefers smooth
pictures, as real ones are (power ~ 1/f^2). delta says how wrong the stored PSF may be. What a slightly wrong PSF, or
light from beyond the sensor's edge, leaves of the flat field is a large smooth shadow: its power falls like 1/f^4, so
beside the picture's it is noise that grows like 1/f^2 towards low frequencies. Taking the flat field out first removes
most of what a cropped sensor would turn into ringing, at no cost in FFTs.
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

DOUBTED_RAD = 0.12  # per sensor pixel: the frequency at which `psf_error` is said, the middle of the passband


@dataclass(frozen=True)
class Prior:
    """R(f) = slope |D|^2 + floor, the relative squared error of the PSF, and whether the flat field comes out first."""

    slope: float
    floor: float
    psf_error: float
    subtract_flat: bool


TIKHONOV = Prior(slope=0.0, floor=1.0, psf_error=0.0, subtract_flat=False)
# psf_error 0.03: over seven simulated retinas 0.02 to 0.07 lie within 0.002 of correlation of each other. Where the eye
# is off by 4 dpt and the PSF is not, 0.940 of the correlation is kept in the worst case; with a doubt that is the same
# at every frequency it was 0.84 for 0.1, and 0.89 for 0.4, which already cost detail.
GRADIENT = Prior(slope=1.0, floor=0.02, psf_error=0.03, subtract_flat=True)


class ClosedForm:
    """One planned closed-form solver; `start` does it all, and allocates nothing that grows with the image."""

    rounds = 1

    def __init__(self, model: Model, prior: Prior, mu: float | None = None) -> None:
        if mu is not None and not 0 < mu < float("inf"):
            raise SettingError(f"a weight mu of {mu} is not a positive number", "Leave mu out: the frame chooses it.")
        self.model, self.prior, self.mu = model, prior, mu
        self.facts: dict[str, Any] = {}
        whole = model.grid.window == model.grid.shape
        self.inbox: Image | None = model.fft.space if whole and not prior.subtract_flat else None
        self.refocus()

    def refocus(self) -> None:
        """Measure anew what depends on the model's OTF."""
        model, prior = self.model, self.prior
        self.sample = Sample.of(model)
        n = model.grid.n
        self.doubt = prior.psf_error * self.sample.passband_power(n) * (DOUBTED_RAD * n) ** 2
        self._weights = prior.slope * self.sample.gradient + prior.floor
        self._delta = self.doubt / (self.sample.gradient + kernels.FLATTEST)

    def start(self, frame: Linear) -> None:
        """Solve, but for the flat field; `facts` is what was chosen and the number that decided.

        Facts: `mu` (relative to |H|^2), `gcv`, `flat_dn`, `background_dn`, `noise_dn`, `residual` (rms over noise).
        """
        model, prior, size = self.model, self.prior, self.model.grid.size
        level, background = self._take_in(frame)
        spectrum = model.fft.forward()
        energies = self.sample.energies(spectrum)
        share = model.grid.window[0] * model.grid.window[1] / size
        noise = (self.sample.noise_variance(energies, size) / share) ** 0.5
        mu, score = self._weight_of_the_prior(energies)
        misfit = self.sample.misfit(mu * self._weights + self._delta, energies, size)
        gradient = model.row_gradient, model.col_gradient
        kernels.wiener(spectrum, model.otf, gradient, mu * prior.slope, mu * prior.floor, self.doubt, 1 / size)
        model.fft.inverse()
        self.facts = {
            "mu": mu, "gcv": score, "psf_error": prior.psf_error, "flat_dn": level, "background_dn": background,
            "noise_dn": noise, "mean_dn": frame.mean_dn,
            "residual": misfit / (noise * share**0.5) if noise > 0 else 0.0,
        }  # fmt: skip

    def _take_in(self, frame: Linear) -> tuple[float, float]:
        """Put what the flat field leaves of the frame before the FFT; the flat's level and the background, in DN."""
        model, space = self.model, self.model.fft.space
        model.grid.clear_outside(space)
        if not self.prior.subtract_flat:
            if frame.y is not self.inbox:
                space[model.grid.slices] = frame.y  # 0 where nothing was seen
            if model.fade is not None:
                space[model.grid.slices] *= model.fade
            return 0.0, 0.0
        level, background = flat_fit(kernels.dots(frame.y, model.flat, frame.good))
        if model.fade is not None:
            np.multiply(frame.good, model.fade, out=frame.good)
        kernels.residual(frame.y, model.flat, frame.good, level, background, model.grid.at, space)
        return level, background

    def step(self) -> None:
        """Nothing more to do: it is a closed form."""

    def finish(self, out: Image) -> None:
        """Hand the picture over: the flat goes back."""
        kernels.add_flat(self.model.fft.space, self.model.mask, self.facts["flat_dn"], self.model.box, out)

    def _weight_of_the_prior(self, energies: Energies) -> tuple[float, float | None]:
        if self.mu is not None:
            return self.mu, None
        return cross_validated(self.sample.power, self._weights, self._delta, energies)
