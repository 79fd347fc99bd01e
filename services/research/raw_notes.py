"""Notes on the counts of a raw frame that are not those of a sensor: a gamma, JPEG, or fewer bits."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.config.image_files import Raw
from services.research.psf_notes import STENCIL

MAX_SIDE_PX = 512  # of the middle that is examined
MIN_SIDE_PX = 64
MIN_LEVELS, MAX_LEVELS = 8, 256  # too few to show noise; of 8 bits
BINS, MIN_BINS = 10, 5
MIN_LIGHT = 0.15  # of the brightest bin
MIN_CONTRAST = 1.5  # of the brightest bin over the darkest one
MIN_GAMMA = 1.8  # estimate: linear frames have up to 1.6, of 8 bits at 1000 electrons; 2.2 gives 2.1 to 2.3
BLOCK_PX = 8  # of JPEG
MIN_BLOCKINESS = 0.15  # raws up to 0.03, a drawn caustic 0.13, JPEG of quality 60 to 95 0.2 to 5

Floats = NDArray[np.float64]


def raw_notes(raw: Raw, name: str, is_linear: bool) -> tuple[str, ...]:
    """Return sentences about encoded counts, of colour those of the brightest channel.

    `is_linear`: a given gamma makes them linear.
    """
    pixels = raw.pixels
    if pixels.ndim == 3:
        pixels = pixels[..., int(np.argmax(pixels.mean(axis=(0, 1))))]
    middle = np.asarray(pixels[tuple(_middle(size) for size in pixels.shape)], np.float64)
    if min(middle.shape) < MIN_SIDE_PX or not MIN_LEVELS <= np.unique(middle).size <= MAX_LEVELS:
        return ()
    if is_jpeg(middle):
        return (
            f"{name} has the blocks of a JPEG, whose compression changes fine structure. Save the frame of the camera "
            "without compression" + ("." if is_linear else "; of a picture that is all there is, give --gamma 2.2."),
        )
    gamma = None if is_linear else gamma_of(middle)
    if gamma is None:
        return ()
    return (
        f"{name} is not linear in the light: its noise is that of counts with a gamma of about {gamma:.1f}. "
        "Give the linear counts of the camera, or --gamma 2.2.",
    )


def bits_note(raw: Raw, name: str, bit_depth: int) -> tuple[str, ...]:
    """Return a sentence about a raw of 8 bits from a converter with more bits."""
    if raw.stored_bits > 8 or bit_depth <= 8:
        return ()
    return (
        f"{name} has 8 bits, and the head's converter {bit_depth}: faint detail is lost. "
        "Save the frame with all bits, as tiff, png or npy of 16 bits.",
    )


def gamma_of(pixels: Floats) -> float | None:
    """Return the exponent g of counts y ~ light^(1 / g) by their noise; None for linear counts, or if unknown.

    The variance of shot noise is proportional to the light, that of such counts to y^(2 - g). Read noise and rounding
    lower the slope of linear counts, a black level and structure of the light raise it.
    """
    level = ndimage.uniform_filter(pixels, 5)
    noise = ndimage.convolve(pixels, STENCIL.astype(np.float64))
    lit = level > MIN_LIGHT * np.quantile(level, 0.98)
    edges = np.quantile(level[lit], np.linspace(0, 1, BINS + 1))
    bins = [lit & (level >= low) & (level <= high) for low, high in pairwise(edges)]
    levels = np.array([level[part].mean() for part in bins])
    powers = np.array([(noise[part] ** 2).mean() for part in bins])
    if levels[-1] < MIN_CONTRAST * levels[0] or np.count_nonzero(powers) < MIN_BINS:
        return None
    known = powers > 0
    slope = float(np.polyfit(np.log(levels[known]), np.log(powers[known]), 1)[0])
    return 2 - slope if 2 - slope > MIN_GAMMA else None


def is_jpeg(pixels: Floats) -> bool:
    """Return whether the counts jump at every eighth column and row: blocks of a JPEG, cropped anywhere."""
    return min(_blockiness(pixels), _blockiness(pixels.T)) > MIN_BLOCKINESS


def _blockiness(pixels: Floats) -> float:
    """Return the largest mean jump between columns eight apart over that of the others, minus 1."""
    steps = np.diff(pixels, axis=1)
    jumps = np.abs(steps[:, 1:-1] - (steps[:, :-2] + steps[:, 2:]) / 2).mean(axis=0)
    means = np.array([jumps[k::BLOCK_PX].mean() for k in range(BLOCK_PX)])
    others = (means.sum() - means.max()) / (BLOCK_PX - 1)
    return float(means.max() / others - 1) if others > 0 else 0.0


def _middle(size: int) -> slice:
    first = max(0, (size - MAX_SIDE_PX) // 2)
    return slice(first, first + min(size, MAX_SIDE_PX))
