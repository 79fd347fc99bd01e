"""Wrong PSFs for a frame: mirrored, rotated, shuffled in blocks, or from another head."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.values import Image


def orientations(psf: Image) -> dict[str, Image]:
    """Return the PSF mirrored left to right, mirrored up to down, and rotated by 180 degrees."""
    views = {"mirrored left-right": psf[:, ::-1], "mirrored up-down": psf[::-1], "rotated by 180": psf[::-1, ::-1]}
    return {name: np.ascontiguousarray(image) for name, image in views.items()}


def shuffled(psf: Image, blocks: int = 8, seed: int = 0) -> Image:
    """Return the PSF with blocks x blocks parts in random order; the incomplete parts at the far edges are dark."""
    rows, cols = (size // blocks for size in psf.shape)
    image = np.zeros_like(psf)
    parts = psf[: rows * blocks, : cols * blocks].reshape(blocks, rows, blocks, cols).swapaxes(1, 2)
    mixed = parts.reshape(-1, rows, cols)[np.random.default_rng(seed).permutation(blocks**2)]
    image[: rows * blocks, : cols * blocks] = (
        mixed.reshape(blocks, blocks, rows, cols).swapaxes(1, 2).reshape(rows * blocks, cols * blocks)
    )
    return image


def resized(psf: Image, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the PSF of another head, interpolated to `shape`."""
    factors = [want / have for want, have in zip(shape, psf.shape, strict=True)]
    return np.asarray(np.maximum(ndimage.zoom(psf, factors, order=1), 0), np.float32)
