"""Empirical-Bayes prior: a power law fitted to the frame's spectrum, without a user parameter (NUMERICS.md 3.6).

A retina's residual power falls like g(f) = A f^-k. The frame's power spectrum then is |H|^2 g + s2, with the OTF H and
the known noise s2; A and k maximise the likelihood of the measured one. s2/g is the Wiener filter's regularisation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon.model import fused_kernels
from device.recon.model.forward_model import Model
from device.values import Image

BINS = 12
REPETITIONS = 6
STEPS = 5


@dataclass(frozen=True)
class PowerLaw:
    """g(f) = exp(log_power) (f / reference)^-slope, in the square of the residual spectrum's units.

    `reference` is `PowerLawPrior.reference` in cycles per sample; `slope` is k.
    """

    log_power: float
    slope: float


@dataclass(frozen=True)
class Fit:
    """The fitted power law and its data.

    `seen` is |spectrum|^2 of the band's frequencies, (frequencies,); `levels` the estimate of g per ring, (BINS,).
    """

    law: PowerLaw
    seen: NDArray[np.float64]
    levels: NDArray[np.float64]


class PowerLawPrior:
    """The frequency band used for the prior of one model, and the fit.

    Lower limit: 16 cycles across the window; lower frequencies contain the crop edge and the shading. Upper limit: the
    mean |H|^2 falls below 5 % of its maximum; at most 0.45 cycles per sample. f is in cycles per sample.
    """

    def __init__(self, model: Model) -> None:
        rows, cols = model.grid.shape
        frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
        power = np.abs(model.otf.astype(np.complex128)) ** 2
        self.low, self.high = band(frequency, power, max(model.grid.window))
        self.where = np.flatnonzero((frequency > self.low) & (frequency < self.high))
        chosen = frequency.ravel()[self.where]
        self._model = model
        self.refocus()
        edges = np.geomspace(self.low, self.high, BINS + 1)
        self.bins = np.clip(np.digitize(chosen, edges) - 1, 0, BINS - 1)
        self.reference = float(np.sqrt(self.low * self.high))
        self.middles = np.log(np.sqrt(edges[1:] * edges[:-1]) / self.reference)
        self.logs = np.log(chosen / self.reference)
        floor = np.maximum(frequency, self.low)  # constant below the band, where the shading fit has removed the light
        self.all_logs: Image = np.log(floor / self.reference).astype(np.float32)

    def refocus(self) -> None:
        """Use the present OTF of the model; the band is kept, since a scale of a few per cent hardly moves it."""
        self.power = np.abs(self._model.otf.ravel()[self.where].astype(np.complex128)) ** 2

    def fit(self, spectrum: NDArray[np.complex64], noise_dn2: float) -> "Fit":
        """Return the power law with the highest likelihood of |spectrum|^2, given the noise power per frequency.

        A level per ring is estimated by reweighted least squares, a line is fitted to the logarithms, and Fisher
        scoring on all frequencies of the band refines it.
        """
        seen = np.abs(spectrum.ravel()[self.where].astype(np.complex128)) ** 2
        levels = np.empty(BINS)
        fused_kernels.ring_levels(seen, self.power, self.bins, noise_dn2, REPETITIONS, levels)
        sound = levels > 1e-4 * levels.max()
        slope = -2.0
        log_power = float(np.log(max(levels.max(), 1e-300)))
        if sound.sum() > 2:
            slope, log_power = np.polyfit(self.middles[sound], np.log(levels[sound]), 1)
        law = fused_kernels.most_likely_power_law(seen, self.power, self.logs, noise_dn2, log_power, -slope, STEPS)
        return Fit(PowerLaw(*law), seen, levels)

    def regularisation(self, law: PowerLaw, noise_dn2: float) -> Image:
        """Return s2 / g, float32 (rows, cols // 2 + 1), as the grid's rfft is laid out; constant below the band."""
        exponent = np.float32(law.slope) * self.all_logs + np.float32(np.log(noise_dn2) - law.log_power)
        reg: Image = np.exp(np.clip(exponent, -80, 80))
        return reg


def band(frequency: NDArray[np.float64], power: NDArray[np.float64], samples: int) -> tuple[float, float]:
    """Return the limits (low, high) of the band in cycles per sample.

    low is 16 / `samples`, at most 0.1; high is the ring where the mean `power` falls below 5 % of its maximum, from
    2 low to 0.45. `frequency` and `power` are half-plane arrays of equal shape.
    """
    low = min(16 / samples, 0.1)
    edges = np.linspace(low, 0.45, 24)
    rings = np.digitize(frequency.ravel(), edges)
    sums = np.bincount(rings, power.ravel(), edges.size + 1)[1:-1]
    means = sums / np.maximum(np.bincount(rings, minlength=edges.size + 1)[1:-1], 1)
    best = int(np.argmax(means))
    weak = np.flatnonzero(means[best:] < 0.05 * means[best])
    high = edges[best + weak[0]] if weak.size else edges[-1]
    return low, float(max(high, 2 * low))
