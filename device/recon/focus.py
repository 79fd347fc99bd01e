"""Which of several PSFs explains a frame: the one under which the frame is most likely."""

import numpy as np

from device.recon import kernels
from device.recon.choose import LADDER, Energies, Sample, flat_fit
from device.recon.kernels import Pixels
from device.recon.model import periodic_model, taper
from device.recon.plan import Planner
from device.recon.prepare import Preparer
from device.values import Calibration


def evidence(sample: Sample, energies: Energies) -> float:
    """Minus the log likelihood per frequency of |Y|^2 ~ A |H|^2/|D|^2 + s^2 at its best A, s^2 (optics.md 6.2)."""
    spectrum = sample.power / (sample.gradient + 1e-3) + LADDER[:, None]
    amplitude = (energies / spectrum).mean(axis=1)
    return float((np.log(amplitude) + np.log(spectrum).mean(axis=1)).min())


def sharpest(calibration: Calibration, counts: Pixels, planner: Planner) -> tuple[int, list[float]]:
    """The index of the PSF with the greatest evidence, and minus the log evidence of each; colour frames by their mean.

    The flat model is fitted again with each candidate (numerics.md, the trap), and the frame's edge is tapered.
    """
    frame = counts if counts.ndim == 2 else counts.mean(axis=2).astype(np.float32)
    shape = (frame.shape[0], frame.shape[1])
    if len(calibration.psfs) == 1:
        return 0, []
    n = 2 if min(shape) >= 600 else 1
    scores = []
    for index in range(len(calibration.psfs)):
        model = periodic_model(calibration, shape, n, planner, index)
        linear = Preparer(calibration, model.grid)(frame)
        level, background = flat_fit(kernels.dots(linear.y, model.flat, linear.good))
        seen = linear.good * taper(model.grid.window)
        kernels.residual(linear.y, model.flat, seen, level, background, model.grid.at, model.fft.space)
        sample = Sample.of(model)
        scores.append(evidence(sample, sample.energies(model.fft.forward())))
    return int(np.argmin(scores)), scores
