"""Compilation of the kernels into Numba's cache on the disk: `python -m tests.compile_kernels`.

Without it, each of the parallel test processes of a fresh checkout compiles the same kernels, 20 s of processor time.
"""

import diffuscope
import numpy as np

from device.recon.methods import METHODS
from tests.scenes import speckle

SHAPE = (96, 128)


def compile_kernels() -> None:
    """Reconstruct a small frame by every method, as integers and as floating point, with and without dark and flat."""
    psf = speckle(SHAPE)
    rng = np.random.default_rng(0)
    truth = rng.poisson(2000, SHAPE).astype(np.float32)
    flat = np.full(SHAPE, 1000, np.float32)
    for method in METHODS:
        diffuscope.reconstruct(truth.astype(np.uint16), psf, method=method)
    for dtype in (np.uint8, np.uint16, np.float32):
        raw = (truth / truth.max() * 250).astype(dtype)
        diffuscope.reconstruct(raw, psf)
        diffuscope.reconstruct(raw, psf, dark=np.full(SHAPE, 10, dtype))
        diffuscope.reconstruct(raw, psf, flat=flat)


if __name__ == "__main__":
    compile_kernels()
