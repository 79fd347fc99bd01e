"""Ceiling of an image: the value at which sensor, amplifier or converter ended, found from the pixels alone.

Only the order of the values is used, so that any strictly increasing map of them (black level subtracted, divided by
full scale, gamma) leaves the same pixels at the ceiling:

* More than CHANCE_PIXELS pixels have the maximum.
* None of the LEVELS next lower values has more than 1 / PILE_UP of them. The tail of unclipped noise thins out towards
  its maximum, and a smooth maximum has about as many pixels at each of its levels.
* The values below are noisy, as those of a sensor: of four neighbours in a row or column below the maximum, at least
  MIN_ZIGZAG rise and fall in turn (0.4 in white noise, 0.006 to 0.2 in clipped frames, below 0.0007 in blurred images
  without noise). A computed flat top, such as the middle of a synthetic flat frame, is no ceiling.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

CHANCE_PIXELS = 8  # so few pixels may reach the maximum by chance
LEVELS = 8
PILE_UP = 4.0
MIN_ZIGZAG = 0.002


def ceiling_of(values: NDArray[Any]) -> float | None:
    """Return the ceiling of an image (rows, cols) of numbers, in its own units; None for one that is not clipped."""
    top = values.max()
    at_top = values == top
    full = np.count_nonzero(at_top)
    if full <= CHANCE_PIXELS:
        return None
    level = top
    below = values[~at_top]
    for _ in range(LEVELS):
        below = below[below < level] if level < top else below
        if not below.size:
            return None
        level = below.max()
        if PILE_UP * np.count_nonzero(below == level) > full:
            return None
    return float(top) if _zigzag_share(values, top) >= MIN_ZIGZAG else None


def _zigzag_share(values: NDArray[Any], top: Any) -> float:
    """Return the share of alternating fours in rows and columns, of those whose middle is between minimum and `top`."""
    found = counted = 0
    for line in (values, values.T):
        a = line[:, :-3]
        b = line[:, 1:-2]
        c = line[:, 2:-1]
        d = line[:, 3:]
        inside = (np.maximum(b, c) < top) & (np.minimum(b, c) > values.min())
        alternating = ((a < b) & (b > c) & (c < d)) | ((a > b) & (b < c) & (c > d))
        found += int(np.count_nonzero(alternating & inside))
        counted += int(np.count_nonzero(inside))
    return found / max(counted, 1)
