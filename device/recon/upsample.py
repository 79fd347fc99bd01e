"""From a binned grid back to the sensor's, every sample where it belongs."""

import numpy as np
from scipy import ndimage

from device.values import Image


def upsample(picture: Image, n: int, shape: tuple[int, int]) -> Image:
    """A picture on blocks of n x n pixels as (rows, cols) = `shape` pixels: cubic, block centres kept in place.

    Sample I stands at pixel n I + (n - 1)/2. Rows and columns beyond the last whole block repeat its edge.
    """
    if n == 1:
        return np.array(picture, np.float32)
    if picture.ndim == 3:
        return np.stack([upsample(picture[..., c], n, shape) for c in range(picture.shape[2])], axis=-1)
    out = np.empty(shape, np.float32)
    offset = -(n - 1) / 2 / n
    ndimage.affine_transform(
        picture, np.full(2, 1 / n), offset=offset, output_shape=shape, output=out, order=3, mode="nearest"
    )
    return out
