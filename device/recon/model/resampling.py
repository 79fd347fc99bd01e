"""Resampling: a binned picture to the pixels of the sensor by cubic interpolation, and an image by a given shift."""

import numpy as np

from device.recon.model import kernels
from device.recon.model.grid import Grid
from device.values import Image

TAPS = 5  # of the windowed sinc, to either side
MIN_PART_PX = 0.005  # a smaller part of a pixel is not interpolated


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


def block_mean(picture: Image, block: int) -> Image:
    """Return the means of blocks of `block` x `block` pixels of an image, (rows, cols) or (rows, cols, 3).

    Incomplete blocks at the edge are dropped.
    """
    if block < 2:
        return picture
    down, across = (min(block, length) for length in picture.shape[:2])  # a narrow picture may be thinner than a block
    rows = picture.shape[0] // down * down
    cols = picture.shape[1] // across * across
    strips = sum((picture[row:rows:down] for row in range(1, down)), start=picture[0:rows:down])
    total = sum((strips[:, col:cols:across] for col in range(1, across)), start=strips[:, 0:cols:across])
    return np.asarray(total / np.float32(down * across), np.float32)


def moved_back(image: Image, good: Image, shift_px: tuple[float, float]) -> tuple[Image, Image]:
    """Return image(r + shift) and the share of good pixels behind it, 0 or 1, both (rows, cols) float32.

    `image` is 0 where `good` is 0. See `add_moved_back`.
    """
    moved = np.zeros_like(image)
    kept = np.zeros_like(good)
    add_moved_back(image, good, shift_px, 1.0, 1.0, moved, kept)
    return moved, kept


def add_moved_back(
    image: Image, good: Image, shift_px: tuple[float, float], weight: float, gain: float, total: Image, weights: Image
) -> None:
    """Add weight gain image(r + shift) to `total` and `weight` to `weights`, all (rows, cols) float32, in place.

    Only where the pixels are good, 1 in `good`. Band-limited interpolation by a windowed sinc of 2 TAPS + 1 taps per
    axis, which keeps the noise white up to 0.4 cycles per pixel; a pixel with a missing one under its taps, or from
    beyond the image, is missing itself.
    """
    down, across = (round(shift) for shift in shift_px)
    taps = sinc_taps(shift_px[0] - down), sinc_taps(shift_px[1] - across)
    kernels.add_moved(
        np.ascontiguousarray(image), np.ascontiguousarray(good), (down, across), taps, weight, gain, total, weights
    )


def sinc_taps(part: float) -> Image:
    """Return the 2 TAPS + 1 weights, sum 1, that interpolate at `part` (-0.5 to 0.5) pixels from the middle tap.

    For less than MIN_PART_PX it is a single weight: nothing is interpolated.
    """
    if abs(part) <= MIN_PART_PX:
        return np.ones(1, np.float32)
    place = np.arange(-TAPS, TAPS + 1) - part
    weights = np.sinc(place) * np.i0(5 * np.sqrt(np.clip(1 - (place / (TAPS + 0.5)) ** 2, 0, 1)))
    return np.asarray(weights / weights.sum(), np.float32)
