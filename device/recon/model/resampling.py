"""Resampling of a binned picture to the pixels of the sensor by cubic interpolation, without a shift."""

import numpy as np

from device.recon.model import kernels
from device.recon.model.grid import Grid
from device.values import Image


def cubic_weights(n: int) -> tuple[np.ndarray, Image]:
    """Return the offset of the first of four taps (n,) and the weights of all four (n, 4), for each pixel of a block.

    A tap is a sample; its offset is relative to the block's own sample. Keys' cubic with a = -1/2. Sample I is at pixel
    n I + (n - 1)/2, so pixel p of block I is at a distance of (p - (n - 1)/2)/n blocks from it.
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
    """Return a picture on a grid, (rows, cols) or (rows, cols, 3), as float32 pixels of its sensor.

    Only the shown part is computed; the rest is 0. Pixels beyond the last whole block of the sensor repeat the edge of
    the picture. If the shown part has no negative value, neither has the result.
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
    kernels.interpolate_cubic(
        np.ascontiguousarray(picture), first, weights, grid.offset_px, (top, bottom, left, right), out
    )
    if picture[grid.shown].min() >= 0:  # the cubic overshoots at the field edge; light is not negative
        shown = out[top:bottom, left:right]
        np.maximum(shown, 0, out=shown)
    return out


def _pixels(part: slice, axis: int, grid: Grid) -> tuple[int, int]:
    """Return the first sensor pixel of a span of samples along an axis, and the pixel after its last one.

    If the window holds all whole blocks of the sensor, a span that reaches its end also takes the remaining pixels.
    """
    whole = grid.window[axis] == grid.sensor[axis] // grid.n
    low = max(part.start * grid.n - grid.offset_px[axis], 0)
    high = min(part.stop * grid.n - grid.offset_px[axis], grid.sensor[axis])
    if whole and part.start == grid.at[axis]:
        low = 0
    if whole and part.stop == grid.at[axis] + grid.window[axis]:
        high = grid.sensor[axis]
    return low, high
