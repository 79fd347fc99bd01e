"""Notes on a PSF image: stray light that rises over it, values cut off below, too few counts, noise."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.config.image_files import Raw, background_plane
from device.values import Mask, Psf

MIN_CUT_SHARE = 0.05  # of the pixels: with all their neighbours at the lowest value
MIN_CUT_STEPS, MIN_CUT_RATIO = 4.0, 0.002  # values beside them: in smallest steps, and of the highest value
MIN_STEPS = 40.0  # of the highest value: 20 cost PCC .04, 55 .01
MAX_NOISE_RATIO = 0.3  # noise power over all power of the PSF
STENCIL = (np.outer([1, -2, 1], [1, -2, 1]) / 6).astype(
    np.float32
)  # of white noise its rms; of light that is smooth over 3 pixels, 0

Floats = NDArray[np.float64]


def background_notes(raw: Raw, name: str) -> tuple[str, ...]:
    """Return a sentence about stray light that rises over a PSF image and is taken out; empty without any."""
    pixels = _mean_channel(raw)
    plane = background_plane(pixels, ~raw.bad)
    if plane is None:
        return ()
    share = float(np.ptp(plane)) / float(pixels.max() - plane.min())
    return (
        f"{name}: stray light that rises by {share:.0%} of the highest value over the image was taken out. "
        "Measure the PSF again in a dark room.",
    )


def damage_notes(raw: Raw, psf: Psf) -> tuple[str, ...]:
    """Return sentences about a PSF image, of colour about its mean, that is cut off below, has few counts or is noisy.

    `psf` is the same, cleaned.
    """
    pixels = _mean_channel(raw)
    found = []
    ratio = cut_ratio(pixels)
    if ratio is not None:
        found.append(
            f"{psf.name} is cut off below: beside pixels at the lowest value others have {ratio:.1%} of the highest. "
            "Subtract less from it, or measure it with a lower black level."
        )
    steps = float(pixels.max() - np.median(pixels))
    share = noise_ratio(psf.pixels, ~raw.bad)
    if raw.pixels.dtype.kind == "u" and steps < MIN_STEPS:
        found.append(
            f"{psf.name} has few counts: {steps:.0f} above its background at the brightest pixel. "
            "Measure it again with a longer exposure or a brighter point."
        )
    elif share > MAX_NOISE_RATIO:
        found.append(
            f"{psf.name} is noisy: {share:.0%} of its power is noise. "
            "Measure it again with more light, or give the mean of several images."
        )
    return tuple(found)


def _mean_channel(raw: Raw) -> Floats:
    return np.asarray(raw.pixels if raw.pixels.ndim == 2 else raw.pixels.mean(axis=2), np.float64)


def cut_ratio(pixels: Floats) -> float | None:
    """Return the median value beside areas at the lowest value, over the highest; None where light ends gently.

    Light ends in values of one step, or in noise; where more than the black level was subtracted, it ends in a cliff.
    """
    above = pixels - pixels.min()
    at_lowest = above == 0
    areas: Mask = ndimage.binary_erosion(at_lowest, np.ones((3, 3), np.bool_))
    if areas.mean() < MIN_CUT_SHARE or at_lowest.all():
        return None
    beside = float(np.median(above[ndimage.binary_dilation(areas, np.ones((5, 5), np.bool_)) & ~at_lowest]))
    step = float(above[~at_lowest].min())
    ratio = beside / float(above.max())
    return ratio if beside >= MIN_CUT_STEPS * step and ratio >= MIN_CUT_RATIO else None


def noise_ratio(pixels: NDArray[np.float32], good: Mask) -> float:
    """Return the power of the noise of most pixels over the power of the PSF, 0 to about 1."""
    seen = ndimage.convolve(pixels.astype(np.float64), STENCIL)[good]
    noise_sd = float(np.median(np.abs(seen))) / 0.6745
    return noise_sd**2 / max(float((pixels.astype(np.float64) ** 2).mean()), 1e-30)
