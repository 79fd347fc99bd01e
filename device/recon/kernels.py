"""The few passes over pixels and frequencies that numpy would make several of; compiled once, kept on disk.

At 1080 x 1920 a planned FFT pair takes about 15 ms on one core of a laptop; each numpy pass over the frame costs 1 to
3 ms of memory traffic. Fusing them keeps counts-to-picture below 1.5 FFT pairs (`make bench`).
"""

import numba
import numpy as np
from numpy.typing import NDArray

from device.values import Image

Sums = tuple[float, float, float, float, float]
Spectrum = NDArray[np.complex64]
Pixels = NDArray[np.uint16] | NDArray[np.float32]

_jit = numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")


@_jit
def linearise(counts: Pixels, dark: Image, gain: Image, white: float, n: int, out: Image, good: Image) -> int:
    """Counts to linear DN, n x n pixels to one: out = mean of (counts - dark) * gain over the good pixels.

    `gain` is 1/flat, and 0 where a pixel is not to be believed; `good` becomes the good share of each block, 0 to 1;
    a block without a good pixel becomes 0. Values from `white` up are saturated; their number is returned.
    """
    rows, cols = out.shape
    saturated = 0
    for i in range(rows):
        for j in range(cols):
            total = np.float32(0)
            used = 0
            for a in range(i * n, i * n + n):
                for b in range(j * n, j * n + n):
                    value = np.float32(counts[a, b])
                    if value >= white:
                        saturated += 1
                    elif gain[a, b] > 0:
                        total += (value - dark[a, b]) * gain[a, b]
                        used += 1
            out[i, j] = total / used if used else np.float32(0)
            good[i, j] = used / np.float32(n * n)
    return saturated


@_jit
def dots(y: Image, flat: Image, good: Image) -> Sums:
    """Sums over the frame that fit y = a flat + b: <y,f>, <y,1>, <f,f>, <f,1>, <1,1>, each weighted by `good`."""
    yf = y1 = ff = f1 = n = np.float64(0)
    rows, cols = y.shape
    for i in range(rows):
        ryf = ry1 = rff = rf1 = rn = np.float32(0)  # a row in float32, the rows in float64: exact enough, and fast
        for j in range(cols):
            w = good[i, j]
            f = flat[i, j] * w
            ryf += y[i, j] * f
            ry1 += y[i, j] * w
            rff += flat[i, j] * f
            rf1 += f
            rn += w
        yf += ryf
        y1 += ry1
        ff += rff
        f1 += rf1
        n += rn
    return yf, y1, ff, f1, n


@_jit
def residual(y: Image, flat: Image, good: Image, a: float, b: float, out: Image) -> None:
    """out = (y - a flat - b) * good: what the flat model leaves, with silence where nothing was seen."""
    a32, b32 = np.float32(a), np.float32(b)
    rows, cols = y.shape
    for i in range(rows):
        for j in range(cols):
            out[i, j] = (y[i, j] - a32 * flat[i, j] - b32) * good[i, j]


@_jit
def wiener(spectrum: Spectrum, otf: Spectrum, row_g: Image, col_g: Image, floor: float, scale: float) -> None:
    """Multiply a spectrum in place by scale conj(H) / (|H|^2 + row_g + col_g + floor)."""
    rows, cols = spectrum.shape
    floor32, scale32 = np.float32(floor), np.float32(scale)
    for i in range(rows):
        for j in range(cols):
            h = otf[i, j]
            power = h.real * h.real + h.imag * h.imag
            weight = scale32 / (power + row_g[i] + col_g[j] + floor32)
            s = spectrum[i, j]
            spectrum[i, j] = complex(
                (s.real * h.real + s.imag * h.imag) * weight, (s.imag * h.real - s.real * h.imag) * weight
            )


@_jit
def add_flat(x: Image, mask: Image, a: float, out: Image) -> None:
    """out = (x + a) mask: the flat model goes back into the picture, which is dark outside the field."""
    a32 = np.float32(a)
    rows, cols = out.shape
    for i in range(rows):
        for j in range(cols):
            out[i, j] = (x[i, j] + a32) * mask[i, j]


@_jit
def stretch_cols(image: Image, first: NDArray[np.int64], weights: Image, out: Image) -> None:
    """Each column of `out` from four of `image`: column j is pixel j % n of block j // n."""
    n = first.size
    rows, cols = out.shape
    last = image.shape[1] - 1
    for i in range(rows):
        for j in range(cols):
            p = j % n
            k = j // n + first[p]
            total = np.float32(0)
            for tap in range(4):
                total += weights[p, tap] * image[i, min(max(k + tap, 0), last)]
            out[i, j] = total


@_jit
def stretch_rows(image: Image, first: NDArray[np.int64], weights: Image, out: Image) -> None:
    """Each row of `out` from four of `image`: row i is pixel i % n of block i // n."""
    n = first.size
    rows, cols = out.shape
    last = image.shape[0] - 1
    for i in range(rows):
        p = i % n
        k = i // n + first[p]
        a, b = min(max(k, 0), last), min(max(k + 1, 0), last)
        c, d = min(max(k + 2, 0), last), min(max(k + 3, 0), last)
        wa, wb, wc, wd = weights[p]
        for j in range(cols):
            out[i, j] = wa * image[a, j] + wb * image[b, j] + wc * image[c, j] + wd * image[d, j]
