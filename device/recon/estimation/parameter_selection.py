"""Automatic parameter selection: noise from the stopband of the OTF, mu by generalised cross-validation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon.model import kernels
from device.recon.model.fft_plans import Spectrum
from device.recon.model.forward_model import Model

SAMPLES = 10_000  # frequencies; 100,000 select the same mu
EQUAL_SCORES = 1e-6  # relative; the rounding of complex64 spectra. For a PSF that is a point, every mu has one score
Energies = NDArray[np.float64]
MU_CANDIDATES = 10.0 ** np.arange(-8, 1.01, 0.25)


@dataclass(frozen=True)
class FrequencySample:
    """Fixed subset of frequencies, in which a solver chooses its parameters.

    Attributes
    ----------
    where
        Flat indices of the frequencies, (n,).
    power
        |H|^2, (n,).
    gradient
        |D|^2, (n,).
    stopband
        Mask of the quarter with least |H|^2, (n,).
    """

    where: NDArray[np.intp]
    power: Energies
    gradient: Energies
    stopband: NDArray[np.bool_]

    @classmethod
    def of(cls, model: Model) -> "FrequencySample":
        """Select frequencies, evenly spread over the half plane, without 0.

        Parameters
        ----------
        model
            Forward model of the grid.

        Returns
        -------
        FrequencySample
            About SAMPLES frequencies, fewer than twice as many.
        """
        rows, cols = model.otf.shape
        stride = max(1, (rows * cols) // SAMPLES)
        stride += 1 - stride % 2 if cols % 2 == 0 else 0  # even strides over even rows miss columns
        where = np.arange(min(1, rows * cols - 1), rows * cols, stride)
        gradient = model.row_gradient[where // cols] + model.col_gradient[where % cols]
        power = np.abs(model.otf.ravel()[where].astype(np.complex128)) ** 2
        return cls(where, power, gradient.astype(np.float64), power <= np.quantile(power, 0.25))

    def energies(self, spectrum: Spectrum) -> Energies:
        """Return |Y|^2 at the selected frequencies.

        Parameters
        ----------
        spectrum
            Spectrum Y of the grid, complex64 (rows, cols//2 + 1).

        Returns
        -------
        Series
            |Y|^2, float64 (n,).
        """
        return np.asarray(np.abs(spectrum.ravel()[self.where].astype(np.complex128)) ** 2)

    def passband_power(self, n: int) -> float:
        """Return the mean |H|^2 of the passband, 0.05 to 0.2 radians per sensor pixel.

        Parameters
        ----------
        n
            n x n pixels are one sample.

        Returns
        -------
        float
            Mean |H|^2; of all frequencies if the passband is empty.
        """
        radians = np.sqrt(self.gradient) / n
        band = (radians > 0.05) & (radians < 0.2)
        return float(self.power[band].mean()) if band.any() else float(self.power.mean())

    def misfit(self, reg: Energies, energies: Energies, size: int) -> float:
        """Return the rms of y - Hx of the regularised solution.

        Parameters
        ----------
        reg
            Regularisation at each frequency, (n,).
        energies
            |Y|^2, (n,).
        size
            Samples of the grid.

        Returns
        -------
        float
            Rms per sample, in the units of y.
        """
        phi = reg / (self.power + reg)
        return float(np.sqrt((phi**2 * energies).mean() / size))

    def noise_variance(self, energies: Energies, size: int) -> float:
        """Return the variance of the noise, from the stopband.

        Parameters
        ----------
        energies
            |Y|^2, (n,).
        size
            Samples of the grid.

        Returns
        -------
        float
            Variance per sample.
        """
        return float(
            np.median(energies[self.stopband]) / np.log(2) / size
        )  # |Y|^2 of noise is exponential: median = ln 2 mean


def cross_validated(power: Energies, prior: Energies, delta: Energies, energies: Energies) -> tuple[float, float]:
    """Return the mu of MU_CANDIDATES with the least generalised cross-validation score, and that score.

    Of equal scores the smallest mu, which changes the frame least, so that rounding does not decide.
    GCV(mu) = n sum(phi^2 |Y|^2) / (sum phi)^2, phi = reg / (|H|^2 + reg), reg = mu R + delta. The noise level is not
    needed (NUMERICS.md 3.4).
    """
    scores = np.empty(MU_CANDIDATES.size)
    kernels.cross_validation(power, prior, delta, energies, MU_CANDIDATES, scores)
    best = int(np.flatnonzero(scores <= scores.min() * (1 + EQUAL_SCORES))[0])
    return float(MU_CANDIDATES[best]), float(scores[best])


def flat_fit(sums: tuple[float, float, float, float, float]) -> tuple[float, float]:
    """Return (a, b) of the least-squares fit y = a flat + b from its five sums; b = 0 if the two are not separable."""
    yf, y1, ff, f1, n = sums
    determinant = ff * n - f1 * f1
    if determinant <= 1e-6 * ff * n:
        return (yf / ff if ff > 0 else 0.0), 0.0
    a = (yf * n - y1 * f1) / determinant
    return a, (y1 - a * f1) / n
