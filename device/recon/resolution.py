"""The resolution at which a frame is worth solving: what the optics passes, and no finer."""

import numpy as np
from scipy import fft as scipy_fft

from device.values import Psf

EMPTY = 1e-3  # of the best ring's mean |H|^2: thirty times less amplitude than where the optics passes most
EMPTY_OPEN = 5e-3  # for a PSF that is only roughly right; of three recordings, twice of it moves one, from bin 4 to 5
LARGEST = 8


def working_bin(psf: Psf, empty: float = EMPTY) -> int:
    """The largest n for which n x n pixels still sample everything that the OTF passes.

    Frequencies at which the mean |H|^2 has fallen to `empty` (a thousandth) of its best carry no picture at any light
    that a retina gives; the caustic of the paper ends near 40 cycles/mm, so its 5 um pixels may be summed two by two,
    an IMX296's three by three. A PSF without an end (a few pixels wide) keeps every pixel.
    """
    rows, cols = psf.shape
    if min(rows, cols) < 32:
        return 1
    power = np.abs(scipy_fft.rfft2(psf.pixels)) ** 2
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
    edges = np.linspace(0, 0.5, 65)
    rings = np.digitize(frequency.ravel(), edges)
    means = np.bincount(rings, power.ravel(), 66)[1:65] / np.maximum(np.bincount(rings, minlength=66)[1:65], 1)
    best = float(means[2:].max())  # the innermost rings hold the PSF's own outline
    passed = np.flatnonzero(means > empty * best)
    end = edges[passed[-1] + 1]
    return int(np.clip(0.5 // max(end, 1e-3), 1, LARGEST))
