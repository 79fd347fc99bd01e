"""From a binned grid back to the sensor's, every sample where it belongs."""

import numpy as np

from device.recon import kernels
from device.recon.kernels import Box
from device.values import Image


def cubic_weights(n: int) -> tuple[np.ndarray, Image]:
    """For each of n pixels of a block: the offset of its first of four taps, and the taps' weights (n, 4).

    Keys' cubic with a = -1/2; sample I stands at pixel n I + (n - 1)/2, so pixel p of block I lies
    (p - (n - 1)/2)/n blocks from it.
    """
    place = (np.arange(n) - (n - 1) / 2) / n
    first = np.floor(place).astype(np.int64)
    t = place - first
    weights = np.stack(
        [
            ((-0.5 * t + 1) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1,
            ((-1.5 * t + 2) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        axis=1,
    )
    return first - 1, weights.astype(np.float32)


def upsample(picture: Image, n: int, shape: tuple[int, int], box: Box | None = None) -> Image:
    """A picture on blocks of n x n pixels as (rows, cols) = `shape` pixels; beyond the last whole block it repeats.

    `box` (top, bottom, left, right, in blocks) is where the picture is not dark; nothing outside it is computed.
    """
    if picture.ndim == 3:
        return np.stack([upsample(picture[..., c], n, shape, box) for c in range(picture.shape[2])], axis=-1)
    if n == 1:
        return np.array(picture, np.float32)
    first, weights = cubic_weights(n)
    out = np.zeros(shape, np.float32)
    rows, cols = picture.shape
    top, bottom, left, right = box or (0, rows, 0, cols)
    bottom_px = shape[0] if bottom == rows else bottom * n
    right_px = shape[1] if right == cols else right * n
    kernels.stretch(np.ascontiguousarray(picture), first, weights, (top * n, bottom_px, left * n, right_px), out)
    return out
