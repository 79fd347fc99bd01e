"""Closed-form deconvolution by a Wiener filter: one FFT, one filter, one inverse FFT.

    min_X  sum |Y - H X|^2 + mu R |X|^2 + delta |X|^2 / |D|^2,   Y = F(y - a flat - b),   x = mask (a + F^-1 X)
    X = conj(H) Y / (|H|^2 + mu R + delta / |D|^2)

R = 1 and a = b = delta = 0 give the paper's Tikhonov solution (`tikhonov`; paper, section "Algorithm"). `gradient` uses
R = |D|^2 + floor, the prior of pictures whose power falls like 1/f^2. delta models the error of the stored PSF: what a
slightly wrong PSF, or light from beyond the sensor's edge, leaves of the flat field is a smooth shadow with power like
1/f^4, so relative to the picture its power grows like 1/f^2 towards low frequencies. Subtracting the flat field a flat
first removes most of the ringing of a cropped sensor and costs no FFT. The only constraint is the field mask. mu
minimises the generalised cross-validation score unless given. There are no iterations.
"""

from dataclasses import dataclass

import numpy as np

from device.errors import SettingError
from device.recon.estimation.parameter_selection import Energies, FrequencySample, cross_validated, flat_fit
from device.recon.method_settings import Settings
from device.recon.model import kernels
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics
from device.values import Image

PSF_ERROR_RAD = 0.12  # per sensor pixel: the frequency to which `psf_error` refers, the middle of the passband


@dataclass(frozen=True)
class Prior:
    """Regularisation R(f) = slope |D|^2 + floor, relative squared PSF error, and whether the flat is subtracted."""

    slope: float
    floor: float
    psf_error: float
    subtract_flat: bool


TIKHONOV = Prior(slope=0.0, floor=1.0, psf_error=0.0, subtract_flat=False)
# psf_error 0.03: over seven simulated retinas 0.02 to 0.07 differ by at most 0.002 in correlation. With an eye at
# 4 dpt and the PSF of 0 dpt, at least 0.940 of the correlation is kept; with a delta that is the same
# at every frequency it was 0.84 for 0.1, and 0.89 for 0.4, which already cost detail.
GRADIENT = Prior(slope=1.0, floor=0.02, psf_error=0.03, subtract_flat=True)


class ClosedForm:
    """Planned closed-form solver.

    `start` computes the solution and allocates nothing that grows with the image.

    Parameters
    ----------
    model
        Forward model of the stage.
    prior
        Prior of the object.
    mu
        Weight of the prior relative to |H|^2; None: chosen by cross-validation.

    Raises
    ------
    SettingError
        `mu` is not a positive number.
    """

    def __init__(self, model: Model, prior: Prior, mu: float | None = None) -> None:
        if mu is not None and not 0 < mu < float("inf"):
            raise SettingError(f"a weight mu of {mu} is not a positive number", "Leave mu out: the frame chooses it.")
        self.model, self.prior, self.mu = model, prior, mu
        self.diagnostics = Diagnostics()
        self._flat_dn = 0.0
        is_periodic = model.grid.window == model.grid.shape
        self.input_buffer: Image | None = model.fft.space if is_periodic and not prior.subtract_flat else None
        self.refocus()

    def configure(self, settings: Settings) -> None:
        """Use the given `mu` instead of the one that cross-validation chooses.

        Parameters
        ----------
        settings
            Values by name: `mu`.
        """
        self.mu = settings.get("mu", self.mu)

    def refocus(self) -> None:
        """Recompute all quantities that depend on the OTF of the model."""
        model = self.model
        prior = self.prior
        self.sample = FrequencySample.of(model)
        n = model.grid.n
        self.psf_error_term = prior.psf_error * self.sample.passband_power(n) * (PSF_ERROR_RAD * n) ** 2
        self._weights = prior.slope * self.sample.gradient + prior.floor
        self._delta = self.psf_error_term / (self.sample.gradient + kernels.MIN_GRADIENT_POWER)

    def start(self, frame: Linear) -> None:
        """Compute the solution except for the flat field, and store parameters and figures in `diagnostics`.

        They are `mu` (relative to |H|^2), `gcv` (score; None for a given mu), `psf_error`, `flat_dn` and
        `background_dn`.

        Parameters
        ----------
        frame
            Linear frame on the window of the grid.
        """
        model = self.model
        prior = self.prior
        size = self.model.grid.size
        self._flat_dn, background = self._load_frame(frame)
        spectrum = model.fft.forward()
        energies = self.sample.energies(spectrum)
        share = model.grid.window[0] * model.grid.window[1] / size
        noise = (self.sample.noise_variance(energies, size) / share) ** 0.5
        mu, score = self._weight_of_the_prior(energies)
        misfit = self.sample.misfit(mu * self._weights + self._delta, energies, size)
        gradient = model.row_gradient, model.col_gradient
        kernels.wiener(spectrum, model.otf, gradient, mu * prior.slope, mu * prior.floor, self.psf_error_term, 1 / size)
        model.fft.inverse()
        self.diagnostics = Diagnostics(
            noise_dn=noise,
            residual=misfit / (noise * share**0.5) if noise > 0 else 0.0,
            regularisation={
                "mu": mu,
                "gcv": score,
                "psf_error": prior.psf_error,
                "flat_dn": self._flat_dn,
                "background_dn": background,
            },
        )

    def _load_frame(self, frame: Linear) -> tuple[float, float]:
        """Write the frame minus the flat model to the FFT input; return the flat's level and the background in DN.
        Without `prior.subtract_flat` the frame itself is written, and both are 0.
        """
        model = self.model
        space = self.model.fft.space
        model.grid.clear_outside(space)
        if not self.prior.subtract_flat:
            if frame.y is not self.input_buffer:
                space[model.grid.slices] = frame.y  # 0 for missing samples
            if model.fade is not None:
                space[model.grid.slices] *= model.fade
            return 0.0, 0.0
        level, background = flat_fit(kernels.flat_fit_sums(frame.y, model.flat, frame.good))
        if model.fade is not None:
            np.multiply(frame.good, model.fade, out=frame.good)
        kernels.residual(frame.y, model.flat, frame.good, level, background, model.grid.at, space)
        return level, background

    def step(self) -> None:
        """Do nothing: the solution has a closed form."""

    def finish(self, out: Image) -> None:
        """Write the picture, with the flat field added again, inside the box of the field.

        Parameters
        ----------
        out
            Buffer of the picture, float32 of the shape of the grid.
        """
        kernels.add_flat(self.model.fft.space, self.model.mask, self._flat_dn, self.model.box, out)

    def _weight_of_the_prior(self, energies: Energies) -> tuple[float, float | None]:
        if self.mu is not None:
            return self.mu, None
        return cross_validated(self.sample.power, self._weights, self._delta, energies)
