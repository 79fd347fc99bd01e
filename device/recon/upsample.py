"""From a binned grid back to the sensor's, every sample where it belongs."""

import numpy as np

from device.recon import kernels
from device.recon.geometry import Grid
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


def to_sensor(picture: Image, grid: Grid) -> Image:
    """A picture on a grid as (rows, cols) of its sensor, dark outside the field.

    Only the shown part is computed. Beyond the last whole block of an odd-sized sensor the picture repeats its edge.
    """
    if picture.ndim == 3:
        return np.stack([to_sensor(picture[..., c], grid) for c in range(picture.shape[2])], axis=-1)
    out = np.zeros(grid.sensor, np.float32)
    (top, bottom), (left, right) = (_pixels(part, axis, grid) for axis, part in enumerate(grid.shown))
    down, across = grid.offset_px
    if grid.n == 1:
        out[top:bottom, left:right] = picture[top + down : bottom + down, left + across : right + across]
        return out
    first, weights = cubic_weights(grid.n)
    kernels.stretch(np.ascontiguousarray(picture), first, weights, grid.offset_px, (top, bottom, left, right), out)
    if picture[grid.shown].min() >= 0:  # a cubic rings at the field's rim, and light does not
        shown = out[top:bottom, left:right]
        np.maximum(shown, 0, out=shown)
    return out


def _pixels(part: slice, axis: int, grid: Grid) -> tuple[int, int]:
    """The sensor pixels under a span of samples; a window that holds all whole blocks takes the sensor's rest along."""
    whole = grid.window[axis] == grid.sensor[axis] // grid.n
    low = max(part.start * grid.n - grid.offset_px[axis], 0)
    high = min(part.stop * grid.n - grid.offset_px[axis], grid.sensor[axis])
    if whole and part.start == grid.at[axis]:
        low = 0
    if whole and part.stop == grid.at[axis] + grid.window[axis]:
        high = grid.sensor[axis]
    return low, high
