"""Uncertainty of a refraction: quadratic model of the likelihood around its minimum, and the covariance of the minimum.

Two covariances of the minimum are computed from the Hessian A of the negative log likelihood:

    noise    f^2 s A^-1            f: empirical factor SD_FACTOR, s: spread of the taper
    sectors  A^-1 G A^-1           G = sum over blocks of g_b g_b^T, the sandwich estimator (White 1982)

g_b is the gradient of the part of the likelihood that block b of the frequencies (a sector of some rings) contributes.
It is taken at the middle point of the quadratic model, minus the mean over the blocks, which is 0 at the minimum. The
g_b are large where parts of the spectrum disagree, as under a wrong model.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.refraction.edge import Candidate
from device.recon.estimation.refraction.likelihood import RINGS, Band

SD_FACTOR = 1.4  # empirical: with it 23 frames have z scores of rms 1.0; neighbouring frequencies are correlated
SECTORS, RING_GROUPS = 6, 5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Quadratic:
    """Quadratic model of a negative log likelihood around its minimum.

    `minimum` is (d,), `hessian` (d, d) in nats; `gradients` (blocks, d) those of the blocks at the middle point of the
    fit. `is_minimum`: the Hessian is positive definite, and the minimum is within twice the step of the middle point.
    """

    minimum: Floats
    hessian: Floats
    gradients: Floats
    is_minimum: bool

    def covariance(self, spread: float) -> tuple[Floats, Floats]:
        """Return the covariances by noise and by sectors, (d, d) each; only for a minimum."""
        inverse = np.linalg.inv(self.hessian).astype(np.float64)
        centred = self.gradients - self.gradients.mean(axis=0)
        scatter = centred.T @ centred * len(centred) / (len(centred) - 1)
        return np.asarray(SD_FACTOR**2 * spread * inverse), np.asarray(inverse @ scatter @ inverse)

    def sds(self, spread: float) -> Floats:
        """Return the standard deviations of the components of the minimum, (d,); `spread` is that of the taper."""
        noise, sectors = self.covariance(spread)
        return np.asarray(np.sqrt(np.diag(noise) + np.diag(sectors)))


def block_of_frequency(band: Band) -> NDArray[np.int64]:
    """Return the block of each frequency, (K,), 0 to SECTORS * RING_GROUPS - 1."""
    angle = np.arctan2(band.rows, band.cols) % np.pi
    sector = np.minimum((angle * SECTORS / np.pi).astype(np.int64), SECTORS - 1)
    return np.asarray(sector * RING_GROUPS + band.ring * RING_GROUPS // RINGS, np.int64)


def quadratic_model(
    value: Callable[[Floats], Candidate], at: Floats, step: float, blocks: NDArray[np.int64]
) -> Quadratic:
    """Fit a quadratic to the likelihood at `at`, at +-`step` along each axis, and at one point of each pair of axes."""
    size = at.size
    nats = value(at).nats
    unit = np.eye(size) * step
    hessian = np.zeros((size, size))
    gradient = np.zeros(size)
    slopes = np.zeros((SECTORS * RING_GROUPS, size))
    above = np.zeros(size)
    for k in range(size):
        low = value(at - unit[k])
        high = value(at + unit[k])
        above[k] = high.nats
        gradient[k] = (high.nats - low.nats) / (2 * step)
        hessian[k, k] = (high.nats - 2 * nats + low.nats) / step**2
        slopes[:, k] = np.bincount(blocks, high.terms - low.terms, len(slopes)) / (2 * step)
    for k in range(size):
        for other in range(k):
            corner = value(at + unit[k] + unit[other]).nats
            hessian[k, other] = hessian[other, k] = (corner - above[k] - above[other] + nats) / step**2
    if np.linalg.eigvalsh(hessian)[0] <= 0:
        return Quadratic(at, hessian, slopes, is_minimum=False)
    away = -np.linalg.solve(hessian, gradient)
    near = bool(np.abs(away).max() <= 2 * step)
    return Quadratic(at + away if near else at, hessian, slopes, near)
