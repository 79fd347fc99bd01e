"""Selection of the PSF of a stack (depth or refraction) by maximum likelihood of the frame."""

import numpy as np

from device.recon.estimation.parameter_selection import MU_CANDIDATES, Energies, FrequencySample, flat_fit
from device.recon.model import kernels
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import periodic_model, taper
from device.recon.model.kernels import Pixels
from device.recon.model.preprocessing import Preprocessor
from device.values import Calibration


def negative_log_likelihood(sample: FrequencySample, energies: Energies) -> float:
    """Return the negative log likelihood per frequency of |Y|^2 ~ A |H|^2/|D|^2 + s^2 at the best A and s^2.

    `energies` is |Y|^2 of the `sample`; s^2 / A is one of MU_CANDIDATES. See NUMERICS.md 7.3.
    """
    spectrum = sample.power / (sample.gradient + 1e-3) + MU_CANDIDATES[:, None]
    amplitude = (energies / spectrum).mean(axis=1)
    return float((np.log(amplitude) + np.log(spectrum).mean(axis=1)).min())


def most_likely_psf(calibration: Calibration, counts: Pixels, planner: Planner) -> tuple[int, list[float]]:
    """Return the index of the PSF with the highest likelihood, and the negative log likelihood of each.

    The flat model is fitted again for each candidate (NUMERICS.md 3.3), and the frame is tapered at its edge. A colour
    frame is averaged over its channels. A single PSF gives (0, []).
    """
    frame = counts if counts.ndim == 2 else counts.mean(axis=2).astype(np.float32)
    shape = (frame.shape[0], frame.shape[1])
    if len(calibration.psfs) == 1:
        return 0, []
    n = 2 if min(shape) >= 600 else 1
    scores = []
    for index in range(len(calibration.psfs)):
        model = periodic_model(calibration, shape, n, planner, index)
        linear = Preprocessor(calibration, model.grid)(frame)
        level, background = flat_fit(kernels.flat_fit_sums(linear.y, model.flat, linear.good))
        seen = linear.good * taper(model.grid.window)
        kernels.residual(linear.y, model.flat, seen, level, background, model.grid.at, model.fft.space)
        sample = FrequencySample.of(model)
        scores.append(negative_log_likelihood(sample, sample.energies(model.fft.forward())))
    return int(np.argmin(scores)), scores
