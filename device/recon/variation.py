"""The crop-aware solver: weighted data, isotropic total variation, positive inside the field, dark outside.

    min_x  1/2 sum W (y - b - crop(h * x))^2 + tau sum |D x|,   x >= 0 in the field, 0 outside

y is the frame in DN above dark, h the PSF, b the constant stray light. W is one over the noise variance of each sample,
0 for missing samples. tau is KAPPA (fixed and tuned, 1.8) times the rms, in the dual norm of D, of the noise that the
Wiener filter rejects. ADMM with three splits (Antipa et al. 2018 for the crop; here weighted): v = h * x, z = D x,
w = x; two real FFT pairs a round. It starts from the shading fit plus the Wiener solution of the residual: eight rounds
then reach what a hundred reach from zero.
"""

from math import isfinite
from typing import Any

import numpy as np

from device.recon import quality, sweeps
from device.recon.choose import Sample
from device.recon.evidence import Evidence, Fit, PowerLaw
from device.recon.model import Model, taper
from device.recon.noise import Noise
from device.recon.plan import Planner, RealFft
from device.recon.prepare import Linear
from device.recon.shading import Shading
from device.values import Calibration, Image

KAPPA = 1.8  # of tau: within 0.03 dB of the oracle's over 1 to 120 ke-, bins 2 and 3, three diffusers, four retinas
RHO = 5.0  # stiffness of z and w, in units of tau per level
STIFF = 1.0  # stiffness of v, in units of a typical weight
TAPER_PX = 60
FILLS = 2  # of a frame with gaps; see `_fill_gaps`


class EvidenceWiener:
    """Shading fit plus Wiener filter with the fitted empirical-Bayes prior: closed form, no user parameter."""

    rounds = 1
    inbox: Image | None = None

    def __init__(self, model: Model, calibration: Calibration) -> None:
        self.model, self.sensor, self.geometry = model, calibration.sensor, calibration.geometry
        self.shading, self.evidence, self.sample = Shading(model), Evidence(model), Sample.of(model)
        self.fade = taper(model.grid.window, min(0.5, TAPER_PX / model.grid.n / min(model.grid.window)))
        self.x: Image = np.zeros(model.grid.shape, np.float32)
        self.blurred: Image = np.zeros(model.grid.shape, np.float32)
        self.facts: dict[str, Any] = {}
        self.noise, self.law, self.level, self.stray = Noise(0, 1), PowerLaw(0, 2), 0.0, 0.0
        self.noise_dn2, self.reg = 1.0, np.ones(model.otf.shape, np.float32)

    def refocus(self) -> None:
        """Measure anew what depends on the model's OTF."""
        self.shading.refocus()
        self.evidence.refocus()
        self.sample = Sample.of(self.model)

    def start(self, frame: Linear) -> None:
        """Solve: `x` is the picture on the grid, `facts` what was chosen."""
        model, fft, inside = self.model, self.model.fft, self.model.grid.slices
        self.level, self.stray = self.shading.fit(frame, self.x)
        self._blur()
        fft.space[:] = 0
        np.subtract(frame.y, self.blurred[inside], out=fft.space[inside])
        fft.space[inside] -= np.float32(self.stray)
        fft.space[inside] *= frame.good * self.fade
        has_gaps = frame.has_gaps
        left = fft.space[inside].copy() if has_gaps else self.fade
        weight = self.fade * np.sqrt(frame.good) if has_gaps else self.fade
        fit = self._solve_detail(frame, weight)
        for _ in range(FILLS if has_gaps else 0):
            self._fill_gaps(left, frame.good)
            fit = self._solve_detail(frame, weight)
        self.x += fft.space
        self.x *= model.mask
        np.maximum(self.x, 0, out=self.x)
        mean = frame.mean_dn
        self.facts = {
            "prior_slope": self.law.slope, "prior_log_power": self.law.log_power, "flat_dn": self.level,
            "background_dn": self.stray, "noise_dn": self.noise.variance_dn2(mean) ** 0.5, "mean_dn": mean,
            "quality": self._quality(fit, mean),
        }  # fmt: skip

    def _solve_detail(self, frame: Linear, weight: Image) -> Fit:
        """Replace the residual in `fft.space` by its Wiener solution, with the noise and the prior that it supports.

        `weight` (the window's shape) is what each sample of the residual was multiplied by, the gaps' with 0.
        """
        grid, fft = self.model.grid, self.model.fft
        spectrum = fft.forward()
        energy = float(np.vdot(weight, weight))
        measured = self.sample.noise_variance(self.sample.energies(spectrum), grid.size) * grid.size
        self.noise = Noise.of(self.sensor, grid.n, measured / energy, frame.mean_dn)
        lit = float(np.einsum("ij,ij,ij->", frame.y, weight, weight))
        self.noise_dn2 = max(self.noise.per_dn * lit + self.noise.floor_dn2 * energy, 1e-20)
        fit = self.evidence.fit(spectrum, self.noise_dn2)
        self.law = fit.law
        self.reg = self.evidence.regularisation(self.law, self.noise_dn2)
        sweeps.wiener_with(spectrum, self.model.otf, self.reg, 1 / grid.size)
        fft.inverse()
        return fit

    def _fill_gaps(self, left: Image, good: Image) -> None:
        """Put `left` back into `fft.space`, its gaps filled with what the solution that stands there predicts.

        One step of expectation maximisation for missing data: a gap filled with zeros is an edge that no retina has.
        """
        fft, inside = self.model.fft, self.model.grid.slices
        spectrum = fft.forward()
        spectrum *= self.model.otf
        predicted = fft.inverse()[inside] * np.float32(1 / self.model.grid.size)
        fft.space[:] = 0
        fft.space[inside] = left + predicted * (1 - good)

    def _quality(self, fit: Fit, mean_dn: float) -> dict[str, float | None]:
        limit = quality.cutoff(self.evidence, fit.law, self.noise_dn2, self.model.grid.n, self.geometry)
        nats, sure = quality.structure(self.evidence, fit.seen, fit.levels, self.noise_dn2)
        return {
            "structure_nats": nats,
            "structure_sure": sure,
            "through": 1 - self.stray / mean_dn if mean_dn > 0 else None,
            "coverage": None,
            "cutoff_per_px": limit.cycles_per_px,
            "resolution_um": limit.half_period_um,
        }

    def _blur(self) -> None:
        """blurred = h * x."""
        fft = self.model.fft
        fft.space[:] = self.x
        spectrum = fft.forward()
        spectrum *= self.model.otf
        np.multiply(fft.inverse(), np.float32(1 / self.model.grid.size), out=self.blurred)

    def step(self) -> None:
        """Nothing more to do: it is a closed form."""

    def finish(self, out: Image) -> None:
        """Write the picture to `out` (grid, float32): clipped at 0, zero outside the field.

        Add `coverage` to the quality figures if the field radius is known.
        """
        np.maximum(self.x, 0, out=out)
        out *= self.model.mask
        noise_dn = float(self.noise.variance_dn2(self.level) ** 0.5)
        if isfinite(self.model.grid.radius_samples):  # without a known field, nothing says where light should be
            self.facts["quality"]["coverage"] = quality.coverage(out, self.model.mask, noise_dn)


class Variation(EvidenceWiener):
    """ADMM iterations from the Wiener solution of `EvidenceWiener`.

    `step` runs one iteration; the caller controls their number and the time limit.
    """

    rounds = 12

    def __init__(self, model: Model, calibration: Calibration, planner: Planner) -> None:
        super().__init__(model, calibration)
        self._data: RealFft = planner.plan(model.grid.shape)
        self._image: RealFft = model.fft
        shape = model.grid.shape
        names = ("_ux", "_uy", "_uw", "_a", "_px", "_py", "_weighted", "_inverse")
        self._ux, self._uy, self._uw, self._a, self._px, self._py, self._weighted, self._inverse = (
            np.zeros(shape, np.float32) for _ in names
        )
        self._dual = self._dual_norms()
        self.tau = self.rho = self.stiffness = 0.0
        self._y = self._good = np.zeros(model.grid.window, np.float32)

    def refocus(self) -> None:
        """Measure anew what depends on the model's OTF."""
        super().refocus()
        self._dual = self._dual_norms()

    def _dual_norms(self) -> Image:
        """|H|^2 / |D|^2 per frequency, averaged over the full plane: how loud the data's noise is to the prior."""
        model = self.model
        gradient = model.row_gradient[:, None] + model.col_gradient[None]
        gradient[0, 0] = np.inf
        weights = np.full(model.otf.shape[1], 2.0)
        weights[0] = 1
        if model.grid.shape[1] % 2 == 0:
            weights[-1] = 1
        return np.asarray(np.abs(model.otf) ** 2 / gradient * weights / model.grid.size, np.float32)

    def start(self, frame: Linear) -> None:
        """Compute the Wiener solution, and from it the data weights W, tau and the ADMM penalties.

        `rho` is the penalty parameter for z and w, `stiffness` for v.
        """
        super().start(frame)
        model, grid = self.model, self.model.grid
        typical = 1 / self.noise.variance_dn2(0.5 * float(frame.y.max()))
        rejected = self.reg / (np.abs(model.otf) ** 2 + self.reg)
        self.tau = KAPPA * float(np.sqrt(typical * np.vdot(self._dual, rejected * rejected)))
        self.rho = max(RHO * self.tau / max(abs(self.level), 1e-12), 1e-30)  # a frame without light has no tau
        self.stiffness = STIFF * typical
        self._blur()
        y = self._y = frame.y - np.float32(self.stray)
        self._good = frame.good
        noise = self.noise
        sweeps.weigh(
            self.blurred,
            y,
            frame.good,
            noise.per_dn,
            noise.floor_dn2,
            self.stiffness,
            grid.at,
            self._weighted,
            self._inverse,
        )
        for multiplier in (self._ux, self._uy, self._uw, self._a):
            multiplier[:] = 0
        self.facts["tau"] = self.tau

    def step(self) -> None:
        """One round: two real FFT pairs."""
        model, data, image = self.model, self._data, self._image
        sweeps.shrink(
            self.x, self._ux, self._uy, self._uw, model.mask, self.tau / self.rho, self._px, self._py, image.space
        )
        sweeps.fit_data(self.blurred, self._a, self._weighted, self._inverse, self.stiffness, data.space)
        image.forward()
        data.forward()
        sweeps.join(
            data.spectrum, image.spectrum, model.otf, model.row_gradient, model.col_gradient,
            self.stiffness, self.rho, 1 / model.grid.size, image.spectrum, data.spectrum,
        )  # fmt: skip
        self.x[:] = image.inverse()
        self.blurred[:] = data.inverse()

    def finish(self, out: Image) -> None:
        """Write the picture to `out` (grid, float32), and its misfit to `facts`.

        `residual` is the rms residual in units of the noise, `banding` the flicker figure in `facts["quality"]`.
        """
        super().finish(out)
        noise, grid = self.noise, self.model.grid
        self.facts["residual"] = sweeps.chi(self.blurred, self._y, self._good, noise.per_dn, noise.floor_dn2, grid.at)
        if isfinite(grid.radius_samples):  # else light from outside the frame leaves bands too
            left, light_dn = (self._y - self.blurred[grid.slices]) * self._good, self.facts["mean_dn"]
            self.facts["quality"]["banding"] = quality.banding(left, noise.variance_dn2(light_dn), light_dn)
