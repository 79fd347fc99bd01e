"""Total variation (TV) deconvolution, crop-aware and noise-weighted: positive inside the field, dark outside.

    min_x  1/2 sum W (y - b - crop(h * x))^2 + tau sum |D x|,   x >= 0 in the field, 0 outside

y is the frame in DN above dark, h the PSF, b the constant stray light. W is one over the noise variance of each sample,
0 for missing samples. tau is KAPPA (fixed and tuned, 1.8) times the rms, in the dual norm of D, of the noise that the
Wiener filter rejects. ADMM with three splits (Antipa et al. 2018 for the crop; here weighted): v = h * x, z = D x,
w = x; two real FFT pairs a round, 12 rounds by default. It starts from the shading fit plus the Wiener solution of the
residual: eight rounds then reach what a hundred reach from zero.
"""

from dataclasses import dataclass, replace
from functools import partial
from math import isfinite

import numpy as np

from device.recon.assessment import quality_figures
from device.recon.estimation.background import Background, without
from device.recon.estimation.ghost import find_ghost, ghost_trace
from device.recon.estimation.noise import Noise
from device.recon.estimation.parameter_selection import FrequencySample
from device.recon.estimation.power_law_prior import Fit, PowerLaw, PowerLawPrior
from device.recon.estimation.refraction.field import lamp_light
from device.recon.estimation.shading import Shading
from device.recon.estimation.spots import find_spots
from device.recon.estimation.uneven_light import MIN_UNEVENNESS, find_uneven_light, unevenness
from device.recon.method_settings import Settings
from device.recon.model import fused_kernels
from device.recon.model.fft_plans import Planner, RealFft
from device.recon.model.forward_model import Model, taper
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics
from device.values import Calibration, Image

KAPPA = 1.8  # of tau: within 0.03 dB of the optimum over 1 to 120 ke-, bins 2 and 3, three diffusers, four retinas
RHO = 5.0  # stiffness of z and w, in units of tau per level
STIFF = 1.0  # stiffness of v, in units of a typical weight
TAPER_PX = 60
LAMP_SHARE = 0.3  # of the axis's irradiance: where the lamp gives less, the field counts as unlit by it
FILLS = 2  # of a frame with gaps; see `_fill_gaps`


@dataclass(frozen=True)
class DetailSolution:
    """Wiener solution of the detail of one frame: noise of a sample, prior, and the filter that follows.

    `noise_dn2` is the noise power per frequency of the unnormalised DFT, `reg` the regularisation s2 / g in the shape
    of the OTF, `mean_dn` the mean of the frame.
    """

    noise: Noise
    noise_dn2: float
    reg: Image
    law: PowerLaw
    mean_dn: float


class EvidenceWiener:
    """Shading fit plus Wiener filter with the fitted empirical-Bayes prior: closed form, no user parameter."""

    input_buffer: Image | None = None

    def __init__(self, model: Model, calibration: Calibration) -> None:
        self.model = model
        self.calibration = calibration
        self.shading = Shading(model)
        self.background = Background(self.shading, model.grid.n)
        self.prior = PowerLawPrior(model)
        self.sample = FrequencySample.of(model)
        self.fade = taper(model.grid.window, min(0.5, TAPER_PX / model.grid.n / min(model.grid.window)))
        self.lit = model.mask * (lamp_light(calibration, model.grid) > LAMP_SHARE)
        self.x: Image = np.zeros(model.grid.shape, np.float32)
        self.blurred: Image = np.zeros(model.grid.shape, np.float32)
        self.diagnostics = Diagnostics()
        self.level = 0.0
        self.stray: Image = np.zeros((1, 1), np.float32)  # DN on the window, or one value for all of it
        self.detail = DetailSolution(Noise(0, 1), 1.0, np.ones(model.otf.shape, np.float32), PowerLaw(0, 2), 0.0)
        self.given: Settings = {}

    def configure(self, settings: Settings) -> None:
        """Use the given `prior_slope`, `prior_log_power` (and `tau` of a total variation) instead of the frame's."""
        self.given = dict(settings)

    def refocus(self) -> None:
        """Recompute all quantities that depend on the OTF of the model, after it has changed."""
        self.shading.refocus()
        self.prior.refocus()
        self.sample = FrequencySample.of(self.model)

    def start(self, frame: Linear) -> None:
        """Compute the solution: `x` becomes the picture on the grid, `diagnostics` the parameters and figures."""
        model = self.model
        fft = self.model.fft
        inside = self.model.grid.slices
        uneven = self.background.fit(frame)
        self.level, constant = self.shading.fit(without(frame, uneven), self.x)
        self.stray = np.float32(constant) + (np.zeros((1, 1), np.float32) if uneven is None else uneven)
        self._blur()
        fft.space[:] = 0
        np.subtract(frame.y, self.blurred[inside], out=fft.space[inside])
        fft.space[inside] -= self.stray
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
        law = self.detail.law
        self.diagnostics = Diagnostics(
            noise_dn=self.detail.noise.variance_dn2(mean) ** 0.5,
            regularisation={
                "prior_slope": law.slope,
                "prior_log_power": law.log_power,
                "flat_dn": self.level,
                "background_dn": float(self.stray.mean()),
            },
            quality=self._quality(fit, mean),
        )

    def _add_diagnostics(self, added: Diagnostics) -> None:
        """Add parameters and quality figures to `diagnostics`, and the residual if there is one."""
        known = self.diagnostics
        self.diagnostics = replace(
            known,
            residual=known.residual if added.residual is None else added.residual,
            find_spots=added.find_spots or known.find_spots,
            unevenness=known.unevenness if added.unevenness is None else added.unevenness,
            find_uneven=added.find_uneven or known.find_uneven,
            ghost_trace=known.ghost_trace if added.ghost_trace is None else added.ghost_trace,
            ghost=known.ghost if added.ghost is None else added.ghost,
            regularisation={**known.regularisation, **added.regularisation},
            quality={**known.quality, **added.quality},
        )

    def _solve_detail(self, frame: Linear, weight: Image) -> Fit:
        """Replace the residual in `fft.space` by its Wiener solution, and return the fit of the prior.

        Noise and prior are estimated from the residual and kept in `detail`. `weight` (the window's shape) is the
        factor of each sample of the residual; 0 in gaps.
        """
        grid = self.model.grid
        fft = self.model.fft
        spectrum = fft.forward()
        energy = float(np.vdot(weight, weight))
        measured = self.sample.noise_variance(self.sample.energies(spectrum), grid.size) * grid.size
        noise = Noise.of(self.calibration.sensor, grid.n, measured / energy, frame.mean_dn)
        lit = float(np.einsum("ij,ij,ij->", frame.y, weight, weight))
        noise_dn2 = max(noise.per_dn * lit + noise.floor_dn2 * energy, 1e-20)
        fit = self.prior.fit(spectrum, noise_dn2)
        law = self._law(fit.law)
        reg = self.prior.regularisation(law, noise_dn2)
        fused_kernels.wiener_with(spectrum, self.model.otf, reg, 1 / grid.size)
        fft.inverse()
        self.detail = DetailSolution(noise, noise_dn2, reg, law, frame.mean_dn)
        return fit

    def _law(self, fitted: PowerLaw) -> PowerLaw:
        """Return the prior: each of its two parameters as given, else as fitted to the frame."""
        slope = self.given.get("prior_slope")
        log_power = self.given.get("prior_log_power")
        if slope is None and log_power is None:
            return fitted
        return PowerLaw(fitted.log_power if log_power is None else log_power, fitted.slope if slope is None else slope)

    def _fill_gaps(self, left: Image, good: Image) -> None:
        """Put `left` back into `fft.space`, with the prediction of the present solution in its gaps.

        One step of expectation maximisation for missing data: a gap filled with zeros would add an edge to the picture.
        """
        fft = self.model.fft
        inside = self.model.grid.slices
        spectrum = fft.forward()
        spectrum *= self.model.otf
        predicted = fft.inverse()[inside] * np.float32(1 / self.model.grid.size)
        fft.space[:] = 0
        fft.space[inside] = left + predicted * (1 - good)

    def _quality(self, fit: Fit, mean_dn: float) -> dict[str, float | None]:
        noise_dn2 = self.detail.noise_dn2
        limit = quality_figures.cutoff(self.prior, fit.law, noise_dn2, self.model.grid.n, self.calibration.geometry)
        nats, sure = quality_figures.structure(self.prior, fit.seen, fit.levels, noise_dn2)
        return {
            "structure_nats": nats,
            "structure_sure": sure,
            "through": 1 - float(self.stray.mean()) / mean_dn if mean_dn > 0 else None,
            "coverage": None,
            "cutoff_per_px": limit.cycles_per_px,
            "resolution_um": limit.half_period_um,
        }

    def _blur(self) -> None:
        """Set `blurred` to h * x."""
        fft = self.model.fft
        fft.space[:] = self.x
        spectrum = fft.forward()
        spectrum *= self.model.otf
        np.multiply(fft.inverse(), np.float32(1 / self.model.grid.size), out=self.blurred)

    def step(self) -> None:
        """Do nothing: the solution has a closed form."""

    def finish(self, out: Image) -> None:
        """Write the picture to `out` (grid, float32): clipped at 0, zero outside the field.

        Add `coverage` to the quality figures if the field radius is known.
        """
        np.maximum(self.x, 0, out=out)
        out *= self.model.mask
        noise_dn = float(self.detail.noise.variance_dn2(self.level) ** 0.5)
        if isfinite(self.model.grid.radius_samples):  # without a known field the lit share is undefined
            coverage = quality_figures.coverage(out, self.lit, noise_dn)
            self._add_diagnostics(Diagnostics(quality={"coverage": coverage}))


class TotalVariation(EvidenceWiener):
    """Total-variation solver: ADMM iterations from the Wiener solution of `EvidenceWiener`.

    `step` runs one iteration (a round); the caller controls their number and the time limit.
    """

    rounds = 12

    def __init__(self, model: Model, calibration: Calibration, planner: Planner) -> None:
        super().__init__(model, calibration)
        self.data_fft: RealFft = planner.plan(model.grid.shape)  # of the data; the picture's is that of the model
        shape = model.grid.shape
        names = ("_ux", "_uy", "_uw", "_a", "_px", "_py", "_weighted", "_inverse")
        self._ux, self._uy, self._uw, self._a, self._px, self._py, self._weighted, self._inverse = (
            np.zeros(shape, np.float32) for _ in names
        )
        self._dual = self._dual_norms()
        self.tau = self.rho = self.stiffness = 0.0
        self._y = self._good = np.zeros(model.grid.window, np.float32)

    def refocus(self) -> None:
        """Recompute all quantities that depend on the OTF of the model."""
        super().refocus()
        self._dual = self._dual_norms()

    def _dual_norms(self) -> Image:
        """Return |H|^2 / |D|^2 (0 at frequency 0), the noise gain in the dual norm of D, per frequency of the half
        plane, weighted so that the sum is the mean over the full plane.
        """
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
        model = self.model
        grid = self.model.grid
        noise = self.detail.noise
        reg = self.detail.reg
        typical = 1 / noise.variance_dn2(0.5 * float(frame.y.max()))
        rejected = reg / (np.abs(model.otf) ** 2 + reg)
        chosen = KAPPA * float(np.sqrt(typical * np.vdot(self._dual, rejected * rejected)))
        self.tau = self.given.get("tau", chosen)
        self.rho = max(RHO * self.tau / max(abs(self.level), 1e-12), 1e-30)  # a frame without light has no tau
        self.stiffness = STIFF * typical
        self._blur()
        y = self._y = frame.y - self.stray
        self._good = frame.good
        fused_kernels.data_weights(
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
        self._add_diagnostics(Diagnostics(regularisation={"tau": self.tau}))

    def step(self) -> None:
        """Run one ADMM round: two real FFT pairs."""
        model = self.model
        data = self.data_fft
        image = self.model.fft
        fused_kernels.shrink(
            self.x, self._ux, self._uy, self._uw, model.mask, self.tau / self.rho, self._px, self._py, image.space
        )
        fused_kernels.solve_data_step(self.blurred, self._a, self._weighted, self._inverse, self.stiffness, data.space)
        image.forward()
        data.forward()
        fused_kernels.solve_x_step(
            data.spectrum,
            image.spectrum,
            model.otf,
            model.row_gradient,
            model.col_gradient,
            self.stiffness,
            self.rho,
            1 / model.grid.size,
            image.spectrum,
            data.spectrum,
        )
        self.x[:] = image.inverse()
        self.blurred[:] = data.inverse()

    def finish(self, out: Image) -> None:
        """Write the picture to `out` (grid, float32), and its misfit to `diagnostics`.

        `residual` is the rms residual in units of the noise. With a known field the quality figures also
        have `coverage` and the flicker figure `banding`, and spots and uneven light can be searched for.
        """
        super().finish(out)
        noise = self.detail.noise
        grid = self.model.grid
        residual = fused_kernels.rms_residual(self.blurred, self._y, self._good, noise.per_dn, noise.floor_dn2, grid.at)
        self._add_diagnostics(Diagnostics(residual=residual))
        if isfinite(grid.radius_samples):  # otherwise light from outside the frame causes bands, too
            left = (self._y - self.blurred[grid.slices]) * self._good
            light_dn = self.detail.mean_dn
            banding = quality_figures.banding(left, noise.variance_dn2(light_dn), light_dn)
            self._add_diagnostics(Diagnostics(quality={"banding": banding}))
            seen = self.blurred[grid.slices]
            uneven = unevenness(left, seen, noise)
            trace = ghost_trace(left, out, self.model, self.shading.block)
            is_seen = residual <= quality_figures.MAX_MISFIT
            ghost = find_ghost(trace, left, out, self.blurred, self.model) if is_seen else None
            self._add_diagnostics(Diagnostics(unevenness=uneven, ghost_trace=trace, ghost=ghost))
            if uneven > MIN_UNEVENNESS:
                frame = Linear(self._y + self.stray, self._good.copy(), light_dn, 0.0, 0.0)
                self._add_diagnostics(
                    Diagnostics(find_uneven=partial(find_uneven_light, frame, self.shading.blurred))
                )  # the picture does not wait for the search
            left /= np.sqrt(np.maximum(noise.per_dn * np.maximum(seen, 0) + noise.floor_dn2, 1e-9))
            self._add_diagnostics(Diagnostics(find_spots=partial(find_spots, left, self._good > 0)))
