"""Runs in `.bench-venv`: a real FFT pair by three libraries in turn, float32, one thread. argv: rows cols."""

import json
import sys
import time
from collections.abc import Callable

import ducc0  # type: ignore[import-not-found]
import numpy as np
import pyfftw
from scipy import fft

TURNS = 31


def pairs(rows: int, cols: int) -> dict[str, Callable[[], object]]:
    """Return a forward and inverse transform by each library, into preallocated arrays where supported."""
    image = np.random.default_rng(0).random((rows, cols), np.float32)
    spectrum, back = np.empty((rows, cols // 2 + 1), np.complex64), np.empty_like(image)
    space, half = pyfftw.zeros_aligned(image.shape, np.float32), pyfftw.zeros_aligned(spectrum.shape, np.complex64)
    flags = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT")
    there = pyfftw.FFTW(space, half, axes=(0, 1), flags=flags)
    again = pyfftw.FFTW(half, space, axes=(0, 1), direction="FFTW_BACKWARD", flags=flags)
    space[:] = image

    def ducc() -> None:
        ducc0.fft.r2c(image, nthreads=1, out=spectrum)
        ducc0.fft.c2r(spectrum, lastsize=cols, forward=False, inorm=2, nthreads=1, out=back)

    return {
        "pyFFTW, planned in place": lambda: (there.execute(), again.execute()),
        "scipy.fft": lambda: fft.irfft2(fft.rfft2(image), image.shape, overwrite_x=True),
        "ducc0": ducc,
    }


def main(rows: int, cols: int) -> None:
    acts = pairs(rows, cols)
    times = np.empty((TURNS, len(acts)))
    for turn in times:
        for k, act in enumerate(acts.values()):
            act()
            begin = time.perf_counter()
            act()
            turn[k] = (time.perf_counter() - begin) * 1e3
    print(json.dumps(dict(zip(acts, np.median(times, axis=0).tolist(), strict=True))))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
