"""Predicted gain of a picture by the PSF with the cylinder of an eye over the one that is only scaled by its sphere.

With the power-law prior g, the noise s2 and the PSF H of the eye, the Wiener filter F of a PSF G has the expected error

    E(G) = sum over f of  g |1 - F H|^2 + s2 |F|^2,       F = conj(G) g / (|G|^2 g + s2)

and E(G) / E(H) is the gain (NUMERICS.md 7.8). It holds for the linear solution; what total variation gains is measured
there.
"""

import numpy as np

from device.recon.estimation.power_law_prior import PowerLaw, band
from device.recon.model.fft_plans import Spectrum
from device.recon.model.forward_model import Model
from device.values import Image


class PsfGain:
    """Prediction of the gain on the grid of a model with its stored OTF."""

    def __init__(self, model: Model) -> None:
        rows, cols = model.grid.shape
        frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
        power = np.abs(model.stored.astype(np.complex128)) ** 2
        low, high = band(frequency, power, max(model.grid.window))
        self._logs: Image = np.log(np.maximum(frequency, low) / np.sqrt(low * high)).astype(np.float32)
        self._samples = model.grid.window[0] * model.grid.window[1]

    def __call__(self, right: Spectrum, other: Spectrum, law: PowerLaw, noise_dn: float) -> float:
        """Return the gain in dB by the OTF `right`, that of the eye, over `other`; both (rows, cols//2 + 1).

        `law` is the prior of `PowerLawPrior` for this model, `noise_dn` the standard deviation of a sample in DN.
        """
        ratio = np.float32(max(noise_dn, 1e-10) ** 2 * self._samples) * np.exp(
            np.float32(law.slope) * self._logs - np.float32(law.log_power)
        )
        power = other.real**2 + other.imag**2
        missed = ratio + power - (other.conj() * right).real  # (1 - F H) (|G|^2 + s2/g), its real part
        turned = (other.conj() * right).imag
        wrong = (missed**2 + turned**2 + ratio * power) / (power + ratio) ** 2 / ratio
        least = 1 / (right.real**2 + right.imag**2 + ratio)
        return float(10 * np.log10(wrong.sum(dtype=np.float64) / least.sum(dtype=np.float64)))
