"""Orientation of a stored image: the TIFF and EXIF tag 274, which says how to turn it upright."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError

ORIENTATION = 274


def upright(pixels: NDArray[Any], orientation: int, name: str) -> NDArray[Any]:
    """Return an image, (rows, cols) or (rows, cols, channels), turned and mirrored as its orientation 1 to 8 says.

    FrameError for another number.
    """
    match orientation:
        case 1:
            return pixels
        case 2:
            return pixels[:, ::-1]
        case 3:
            return pixels[::-1, ::-1]
        case 4:
            return pixels[::-1]
        case 5:
            return pixels.swapaxes(0, 1)
        case 6:
            return np.rot90(pixels, -1)
        case 7:
            return pixels[::-1, ::-1].swapaxes(0, 1)
        case 8:
            return np.rot90(pixels)
    raise FrameError(
        f"{name} has the orientation {orientation}, which is none of 1 to 8",
        "Save it upright, without the tag Orientation.",
    )
