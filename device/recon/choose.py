"""Parameters chosen by the frame, never by eye: noise from where the optics is silent, mu by cross-validation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon import kernels
from device.recon.model import Model
from device.recon.plan import Spectrum

SAMPLES = 10_000  # frequencies that decide: a hundred thousand would choose the same rung of the ladder
Energies = NDArray[np.float64]
LADDER = 10.0 ** np.arange(-8, 1.01, 0.25)


@dataclass(frozen=True)
class Sample:
    """A fixed scatter of frequencies: where they are, their |H|^2 and their prior weights."""

    where: NDArray[np.intp]
    power: Energies
    gradient: Energies
    silent: NDArray[np.bool_]

    @classmethod
    def of(cls, model: Model) -> "Sample":
        """Evenly scattered over the half plane, the mean left out; at most SAMPLES of them."""
        rows, cols = model.otf.shape
        stride = max(1, (rows * cols) // SAMPLES)
        stride += 1 - stride % 2 if cols % 2 == 0 else 0  # an even stride over even rows would see columns only
        where = np.arange(min(1, rows * cols - 1), rows * cols, stride)
        gradient = model.row_gradient[where // cols] + model.col_gradient[where % cols]
        power = np.abs(model.otf.ravel()[where].astype(np.complex128)) ** 2
        return cls(where, power, gradient.astype(np.float64), power <= np.quantile(power, 0.25))

    def energies(self, spectrum: Spectrum) -> Energies:
        """|Y|^2 at the sampled frequencies."""
        return np.asarray(np.abs(spectrum.ravel()[self.where].astype(np.complex128)) ** 2)

    def passband_power(self, n: int) -> float:
        """Mean |H|^2 where the optics passes most and pictures live: 0.05 to 0.2 radians per sensor pixel."""
        radians = np.sqrt(self.gradient) / n
        band = (radians > 0.05) & (radians < 0.2)
        return float(self.power[band].mean()) if band.any() else float(self.power.mean())

    def misfit(self, reg: Energies, energies: Energies, size: int) -> float:
        """Root mean square of y - Hx per pixel, for a solution with this regularisation."""
        phi = reg / (self.power + reg)
        return float(np.sqrt((phi**2 * energies).mean() / size))

    def noise_variance(self, energies: Energies, size: int) -> float:
        """Variance per pixel, from the quarter of frequencies that the optics passes least."""
        return float(
            np.median(energies[self.silent]) / np.log(2) / size
        )  # |Y|^2 of noise is exponential: median = ln 2 mean


def cross_validated(power: Energies, prior: Energies, delta: Energies, energies: Energies) -> tuple[float, float]:
    """The mu of the ladder with the least generalised cross-validation score, and that score.

    GCV(mu) = n sum(phi^2 |Y|^2) / (sum phi)^2, phi = reg / (|H|^2 + reg), reg = mu R + delta: the noise need not be
    known (optics.md 5.3).
    """
    scores = np.empty(LADDER.size)
    kernels.cross_validation(power, prior, delta, energies, LADDER, scores)
    best = int(np.argmin(scores))
    return float(LADDER[best]), float(scores[best])


def flat_fit(sums: tuple[float, float, float, float, float]) -> tuple[float, float]:
    """Least squares of y = a flat + b from its five sums; where the two cannot be told apart all is flat."""
    yf, y1, ff, f1, n = sums
    determinant = ff * n - f1 * f1
    if determinant <= 1e-6 * ff * n:
        return (yf / ff if ff > 0 else 0.0), 0.0
    a = (yf * n - y1 * f1) / determinant
    return a, (y1 - a * f1) / n
