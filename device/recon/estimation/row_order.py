"""Order of the rows of a frame: rows that repeat others, and places where rows are missing; NUMERICS.md 6.4.

A camera or a driver that loses packets repeats rows or moves the rest up. No object explains such a frame, and no
weight helps: it is refused. Noise of neighbouring rows is independent; the PSF makes their light
alike.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.errors import FrameError
from device.recon.model.kernels import Pixels
from device.values import Image, Mask

Series = NDArray[np.float64]

MIN_LIKENESS = 0.6  # of the fine texture of two rows, minus the median: independent noise has up to 0.25
MAX_TEXTURE = 0.3  # likeness of most rows: with more the frame is no raw one (scaled, or smooth)
MIN_REPEATED = 0.004  # of the rows
MAX_REPEATED = 0.3  # of the rows: more are those of a scaled file
MIN_VALUES = 16  # different values of a row: dark and saturated rows repeat by chance
SEGMENTS = 8  # of a row, so that a spot, which lies in few, does not decide
SEEN = (
    5  # of them must show a jump: 3 to 19 dust spots in a row looked like one in 16 of 180 frames with 3, in 1 with 4
)
MIN_ROWS = 256  # of a sensor: in few and short rows texture is alike by chance, and a PSF as steep as a jump
SPANS = 135  # in the height of a frame: the rows of each of the two compared means
# Variance of their difference over the largest near by, of the counts and of the shares of a segment's light. Clean
# frames have up to 1.1 and 0.9, dust 1.5 and 1.35; bright frames without 2.2 % of their rows 2.2 and 2.0 (median).
MIN_JUMPS = (1.6, 1.42)
FAINT = 1e-9
MIN_LIGHT = 0.2  # of the brightest row
EVEN = 0.5  # of the brightest of the compared rows: with less it is dead, or the frame ends there
MIN_SPREAD = 0.25  # of the rows that light of a point reaches: with less the object's own edges stay sharp
ROWS_REMEDY = "Take the frame again. If this returns, check the cable of the camera and its driver."


class RowOrder:
    """Test of the order of the rows of frames behind a PSF, given by its `bins` (rows, bins): `Lines.bins`."""

    def __init__(self, psf_bins: Image) -> None:
        light = psf_bins.mean(axis=1)
        spread = float((light > MIN_LIGHT * light.max()).mean())
        self._min_jumps = np.full(2, np.inf)
        if spread >= MIN_SPREAD:
            steepest = [_jumps(psf_bins, 0.0, of_shares).max(initial=0.0) for of_shares in (False, True)]
            self._min_jumps = np.maximum(MIN_JUMPS, steepest)

    def __call__(self, counts: Pixels, bins: Image, likeness: Image, unknown: Image) -> None:
        """Raise FrameError if rows of a frame (rows, cols) of at least MIN_ROWS are repeated or missing.

        `bins`, `likeness` and `unknown` are those of its `Lines`, `bins` in DN above dark.
        """
        if len(bins) < MIN_ROWS:
            return
        rows = np.flatnonzero(_repeated(counts, bins, likeness, unknown))
        if rows.size >= MIN_REPEATED * len(bins):
            raise FrameError(_words(rows), ROWS_REMEDY)
        jumps = _jumps(bins, EVEN)
        places = np.flatnonzero(jumps > self._min_jumps[0])
        if places.size:
            jumps_of_shares = _jumps(bins, EVEN, of_shares=True)
            places = places[jumps_of_shares[places] > self._min_jumps[1]]
        if places.size:
            row = int(places[np.argmax(jumps[places])]) + _span(len(bins))
            raise FrameError(f"rows are missing or at a wrong place from row {row} on", ROWS_REMEDY)


def _words(rows: np.ndarray) -> str:
    if rows[-1] - rows[0] == rows.size - 1:
        return f"rows {rows[0]} to {rows[-1]} repeat other rows of the frame"
    return f"{rows.size} rows repeat other rows of the frame; the first is row {rows[0]}"


def _repeated(counts: Pixels, bins: Image, likeness: Image, unknown: Image) -> Mask:
    """Return the rows that repeat an earlier one, exactly, or the one before with other read noise."""
    found = np.zeros(len(bins), np.bool_)
    usable = (np.ptp(bins, axis=1) > 0) & (unknown == 0)
    texture = float(np.median(likeness)) if likeness.size else 0.0
    light = bins.mean(axis=1)
    lit = light > MIN_LIGHT * light.max()  # in dark rows a rest of the noise of columns exceeds that of pixels
    if texture < MAX_TEXTURE:
        found[1:] = (likeness > texture + MIN_LIKENESS) & (usable & lit)[1:]
    first: dict[bytes, int] = {}
    _, group, members = np.unique(light, return_inverse=True, return_counts=True)
    for i in np.flatnonzero(usable & (members[group] > 1)):
        k = first.setdefault(bins[i].tobytes(), int(i))
        if k < i and np.array_equal(counts[i], counts[k]) and np.unique(counts[i]).size >= MIN_VALUES:
            found[i] = True
    return found


def _span(rows: int) -> int:
    return max(3, rows // SPANS)


def _jumps(bins: Image, even: float, of_shares: bool = False) -> Series:
    """Return the variance ratio of a step at each place to the largest 1 to 3 spans away, (places,).

    The SEEN-th largest of the segments; with `of_shares` in shares of the light of each row's segment, in which a gain
    of some rows is no jump. A place is a row with `_span` rows above it, from the first such row on. 0 where rows are
    not lit, or where one of those that are compared has less than `even` of the light of the brightest.
    """
    span = _span(len(bins))
    if len(bins) < 8 * span or bins.shape[1] < SEGMENTS:
        return np.zeros(0)
    light = bins.mean(axis=1)
    floor = MIN_LIGHT * max(float(light.max()), FAINT)
    width = bins.shape[1] // SEGMENTS
    parts = bins[:, : SEGMENTS * width].reshape(len(bins), SEGMENTS, width)
    if of_shares:
        parts = parts / np.maximum(parts.mean(axis=2, keepdims=True), np.float32(floor))
    left = _steps(parts, span)
    padded = np.pad(left, ((0, 0), (3 * span, 3 * span)), mode="edge")
    largest = ndimage.maximum_filter1d(padded, 2 * span + 1, axis=1)
    places = left.shape[1]
    near = np.maximum(largest[:, span : span + places], largest[:, 5 * span : 5 * span + places])
    windows = np.lib.stride_tricks.sliding_window_view(light, places).T  # (places, 2 span)
    least, most = windows.min(axis=1), windows.max(axis=1)
    lit = (least > floor) & (least >= even * most) & (near > 0)
    return np.asarray(np.sort(np.divide(left, near, out=np.zeros_like(left), where=lit), axis=0)[-SEEN])


def _steps(rows: Image, span: int) -> Image:
    """Return the variance over bins of the step between the means of `span` rows above and below each place.

    `rows`: (rows, segments, bins); the result is (segments, places).
    """
    sums = np.zeros((len(rows) + 1, *rows.shape[1:]))
    np.cumsum(rows, axis=0, out=sums[1:])
    means = np.asarray((sums[span:] - sums[:-span]) / span, np.float32)
    return np.asarray((means[span:] - means[:-span]).var(axis=2).T)
