"""Frames of a burst with a black part, as of a read-out that was cut off: the other frames are lit there.

One frame cannot tell a black part from a dark object, and its solver fits it. Light behind a diffuser spreads over the
whole sensor, so that neither a lid nor the motion of the eye makes a block of pixels black (NUMERICS.md 9.1).
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from device.values import Image, Mask

BLOCK_PX = 8
MIN_LIT = 0.02  # of the brightest block of the other frames
MAX_BLACK = 0.2  # of the light of the other frames, relative to that of the brighter blocks of this one
USUAL_QUANTILE = 0.75  # of the blocks: the light of a frame of which less than three quarters are black
MIN_SHARE = 0.005  # of the lit blocks

Floats = NDArray[np.float64]


def black_parts(lights: Mapping[int, tuple[Image, Mask]]) -> dict[int, str]:
    """Return the reason of each frame that is black where the others are lit.

    `lights` are light above dark in DN and mask of good pixels, (rows, cols), by index.
    """
    if len(lights) < 2:
        return {}
    seen = {k: _block_means(*light) for k, light in lights.items()}
    reasons = {}
    for k, blocks in seen.items():
        others = np.median([light for i, light in seen.items() if i != k], axis=0)
        is_lit = others > MIN_LIT * max(float(np.nanmax(others, initial=0.0)), 1e-9)
        ratios = blocks[is_lit & np.isfinite(blocks)] / others[is_lit & np.isfinite(blocks)]
        if ratios.size and ratios.max() > 0:
            share = float((ratios < MAX_BLACK * np.quantile(ratios, USUAL_QUANTILE)).mean())
            if share >= MIN_SHARE:
                reasons[k] = f"is black in {share:.1%} of the area where the other frames are lit"
    return reasons


def _block_means(light_dn: Image, good: Mask) -> Floats:
    """Return the mean of the good pixels in every second row of each whole block, NaN for a block without any."""
    rows, cols = (size // BLOCK_PX for size in light_dn.shape)
    light, count = (
        image[: rows * BLOCK_PX : 2, : cols * BLOCK_PX]
        .reshape(rows, BLOCK_PX // 2, cols * BLOCK_PX)
        .sum(axis=1, dtype=np.float32)
        .reshape(rows, cols, BLOCK_PX)
        .sum(axis=2)
        for image in (light_dn * good, good.view(np.uint8))
    )
    return np.asarray(np.divide(light, count, out=np.full(light.shape, np.nan), where=count > 0), np.float64)
