"""Bayer mosaics: split into colour planes of half the rows and columns, and the test whether a frame looks like one.

Each plane is solved as a channel of its own: its counts are those of the sensor, so that noise and saturation stay as
measured. A demosaic would mix neighbours, which correlates the noise that the solvers measure in the stopband. The PSF
is split in the same way. A plane of the frame is then the convolution of the object with the same plane of the PSF as
far as the object does not change from one pixel to the next, and the planes of the picture are not displaced against
each other.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from device.errors import FrameError
from device.values import Image

Bayer = Literal["rggb", "bggr", "grbg", "gbrg"]
BayerOption = Literal["rggb", "bggr", "grbg", "gbrg", "none"]  # none: a monochrome frame, whatever its file says
PATTERNS: tuple[Bayer, ...] = ("rggb", "bggr", "grbg", "gbrg")
SITES = ((0, 0), (0, 1), (1, 0), (1, 1))  # row and column of the letters of a pattern
TILES = 8  # per side, of the test for a mosaic
MIN_SIZE = 4 * TILES  # rows and columns of the smallest frame that the test can judge
MIN_CONTRAST = 0.05  # of the four sites, over their mean; a monochrome frame has 0.01 and less


def split(mosaic: NDArray[Any], pattern: Bayer, white_dn: float = float("inf")) -> Image:
    """Return the colour planes of a mosaic, float32 (rows // 2, cols // 2, 3): red, the mean of both greens, blue.

    A mean of which one green is saturated, at least `white_dn`, becomes `white_dn`. An odd last row or column is left
    out. FrameError for a mosaic with channels, or of less than 2 x 2 pixels.
    """
    planes = []
    for colour in "rgb":
        sites = [site for letter, site in zip(pattern, _sites(mosaic), strict=True) if letter == colour]
        saturated = np.max(sites, axis=0) >= white_dn
        planes.append(np.where(saturated, np.float32(white_dn), np.mean(sites, axis=0, dtype=np.float32)))
    return np.stack(planes, axis=2).astype(np.float32)


def mosaic_of(colour: NDArray[Any], pattern: Bayer) -> NDArray[Any]:
    """Return the (rows, cols) mosaic that a sensor with the pattern would see of a (rows, cols, 3) image."""
    mosaic = np.array(colour[..., 1])
    for letter, (row, col) in zip(pattern, SITES, strict=True):
        mosaic[row::2, col::2] = colour[row::2, col::2, "rgb".index(letter)]
    return mosaic


def any_site(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the (rows // 2, cols // 2) mask of the 2 x 2 blocks with at least one pixel set in `mask`."""
    first, second, third, fourth = _sites(mask)
    return np.asarray(first | second | third | fourth, np.bool_)


def looks_like_mosaic(frame: NDArray[Any]) -> bool:
    """Return whether the four sites of the 2 x 2 blocks differ by the same pattern all over a (rows, cols) frame.

    Two sites on a diagonal, the greens, must be nearly equal. False for a frame with less than 32 rows or columns.
    """
    if frame.ndim != 2 or min(frame.shape) < MIN_SIZE:
        return False
    sites = np.stack(_sites(frame)).astype(np.float64)
    rows, cols = (size // TILES for size in sites.shape[1:])
    tiles = sites[:, : rows * TILES, : cols * TILES].reshape(4, TILES, rows, TILES, cols).mean(axis=(2, 4))
    mean = tiles.mean(axis=0)
    lit = mean > 0.1 * mean.max()
    if not lit.any():
        return False
    ratios = tiles[:, lit] / mean[lit]
    typical = np.median(ratios, axis=1)
    contrast = float(np.ptp(typical))
    steady = float(np.median(np.abs(ratios - typical[:, None]))) < 0.5 * contrast
    greens = min(abs(typical[0] - typical[3]), abs(typical[1] - typical[2]))
    return contrast > MIN_CONTRAST and steady and float(greens) < 0.5 * contrast


def pattern_of(
    frame: NDArray[Any], given: BayerOption | None, stated: Bayer | None, black_dn: float, name: str
) -> tuple[Bayer | None, tuple[str, ...]]:
    """Return the pattern of a frame in counts, None for a monochrome one, and a note if that is not certain.

    `given` by the user decides. The label of the file, `stated`, is no proof: picamera2 and rpicam-apps label the raw
    of a monochrome sensor as a mosaic. Pixels that are too few to decide are taken as labelled. FrameError for a
    pattern that is given for a frame with channels.
    """
    if given == "none" or frame.ndim == 3:
        if given not in (None, "none"):
            raise FrameError(f"{name} has three channels, so it is no mosaic", "Leave --bayer out.")
        return None, ()
    if given is not None:
        return given, ()
    mosaic = looks_like_mosaic(frame.astype(np.float32) - black_dn)
    if stated is not None and (mosaic or min(frame.shape) < MIN_SIZE):
        return stated, ()
    if stated is not None:
        return None, (
            f"{name} is labelled as a colour mosaic ({stated}), but its pixels are those of a monochrome sensor. "
            f"It was taken as grey. Give --bayer {stated} if it is a mosaic; --bayer none leaves out this note.",
        )
    if mosaic:
        return None, (
            f"{name} looks like a colour mosaic and was taken as grey. Give --bayer with one of {', '.join(PATTERNS)}; "
            "none leaves out this note.",
        )
    return None, ()


def whole_size(picture: Image, shape: tuple[int, int]) -> Image:
    """Return a picture of planes at the rows and columns `shape` of its mosaic, float32, by linear interpolation.

    Sample (i, j) lies at pixel (2 i, 2 j), moved by one pixel along an axis on which the PSF's centre, `size // 2`, is
    odd.
    """
    for axis, size in enumerate(shape):
        at = (np.arange(size) - (size // 2) % 2) / 2
        low = np.clip(np.floor(at).astype(int), 0, picture.shape[axis] - 1)
        high = np.minimum(low + 1, picture.shape[axis] - 1)
        share = np.clip(at - low, 0, 1).astype(np.float32)
        share = share.reshape([-1 if other == axis else 1 for other in range(picture.ndim)])
        picture = np.take(picture, low, axis) * (1 - share) + np.take(picture, high, axis) * share
    return np.asarray(picture, np.float32)


def _sites(mosaic: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the pixels of the four sites of all 2 x 2 blocks, each (rows // 2, cols // 2)."""
    if mosaic.ndim != 2 or min(mosaic.shape) < 2:
        raise FrameError(
            f"a mosaic has rows and columns without channels; this has the shape {mosaic.shape}",
            "Leave --bayer out for a frame that has its colours already.",
        )
    rows, cols = (size // 2 * 2 for size in mosaic.shape)
    return [mosaic[row:rows:2, col:cols:2] for row, col in SITES]
