"""Selection of the working resolution: bin the sensor to the highest frequency that the optics passes."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from device.values import Psf

STOPBAND_SHARE = 1e-3  # of the maximum ring mean of |H|^2; in amplitude 1/30 of the maximum
STOPBAND_SHARE_OPEN = 5e-3  # for an inaccurate PSF; twice this value changes one of three recordings, from bin 4 to 5
STOPBAND_SHARE_SPOTS = 0.08  # of lenslets: beyond, detail is noise at the light of an eye (NUMERICS.md 7.11)
LARGEST = 8
EDGES = np.linspace(0, 0.5, 65)  # of the rings, in cycles per pixel


def working_bin(psf: Psf, empty: float = STOPBAND_SHARE) -> int:
    """Return the largest bin n, 1 to LARGEST, at which n x n pixels still sample all frequencies that the OTF passes.

    Frequencies beyond the last ring whose mean |H|^2 exceeds `empty` times its maximum carry no information at the
    light levels of a retina. The caustic of the paper ends near 40 cycles/mm, so its 5 um pixels can be binned 2 x 2,
    those of an IMX296 3 x 3; behind lenslets, whose |H|^2 has no end, 2 x 2 (NUMERICS.md 7.11). A PSF with fewer than
    32 rows or columns gives n = 1.
    """
    rows, cols = psf.shape
    if min(rows, cols) < 32:
        return 1
    means = _ring_means(psf)
    best = float(means[2:].max())  # the innermost rings hold the outline of the PSF
    passed = np.flatnonzero(means > empty * best)
    end = EDGES[passed[-1] + 1]
    return int(np.clip(0.5 // max(end, 1e-3), 1, LARGEST))


@lru_cache(maxsize=2)  # each holds its PSF
def _ring_means(psf: Psf) -> NDArray[np.float64]:
    """Return the mean |H|^2 of each ring between two EDGES."""
    rows, cols = psf.shape
    power = np.abs(scipy_fft.rfft2(psf.pixels)) ** 2
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
    rings = np.digitize(frequency.ravel(), EDGES)
    means = np.bincount(rings, power.ravel(), 66)[1:65] / np.maximum(np.bincount(rings, minlength=66)[1:65], 1)
    return np.asarray(means, np.float64)
