"""Checks of the raws of a burst: frames that are the same exposure, PSFs given as frames, a first frame of no use."""

from collections.abc import Sequence
from hashlib import sha256

import numpy as np
from scipy import fft

from device.errors import FrameError
from device.values import FrameUse, Image, Psf
from services.lab.reconstruct_inputs import LoadedRaw

LOW, HIGH = (2, 5), (10, 30)  # cycles per shorter side of a frame
# Power at HIGH over that at LOW, of a frame over that of its PSF: a point has 1 and PSFs of other depths 0.4 to 2.4, an
# object falls with the frequency: recordings have 0.001 to 0.007, simulated frames 0.02 at 100 electrons.
PSF_LIKE = 0.1
BRIGHTEST = 0.9999  # quantile above which pixels are clipped: hot pixels have a flat spectrum
STACK_REMEDY = "Give a stack of PSFs as --psf A --psf B, or as --psf FOLDER; give each frame of a burst once."


def refuse_repeated(loaded: Sequence[LoadedRaw]) -> None:
    """Raise FrameError if two raws of a burst hold the same pixels: the noise of two exposures differs."""
    seen: dict[str, str] = {}
    for one in loaded:
        pixels = one.raw.pixels
        digest = f"{pixels.dtype} {sha256(pixels.tobytes()).hexdigest()}"
        if digest in seen:
            raise FrameError(
                f"{one.name} holds the same pixels as {seen[digest]}, so it is no second exposure",
                "Give each frame of a burst once; one frame is solved alone.",
            )
        seen[digest] = one.name


def refuse_psfs(usable: Sequence[LoadedRaw], psfs: Sequence[Psf]) -> None:
    """Raise FrameError for the first frame with the spectrum of a PSF: it shows a point, and no object."""
    if min(psfs[0].pixels.shape) < 2 * HIGH[1]:
        return  # too few samples for these frequencies
    least = PSF_LIKE * min(_fall(one.pixels) for one in psfs)
    for one in usable:
        if _fall(_grey(one)) > least:
            raise FrameError(f"{one.name} looks like a PSF, not like a frame of a burst", STACK_REMEDY)


def _fall(image: Image) -> float:
    """Return the ratio of the mean power at the frequencies HIGH to that at LOW."""
    clipped = np.minimum(image, np.quantile(image, BRIGHTEST)).astype(np.float64)
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    spectrum = fft.rfft2((clipped - (clipped * window).sum() / window.sum()) * window)
    cycles = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1])[None]) * min(image.shape)
    low, high = (float((np.abs(spectrum[(cycles >= a) & (cycles < b)]) ** 2).mean()) for a, b in (LOW, HIGH))
    return high / max(low, 1e-30)


def refuse_without_first(loaded: Sequence[LoadedRaw], frames: Sequence[FrameUse]) -> None:
    """Raise FrameError if the first raw was left out: the picture would be on the grid of another one."""
    if not frames[0].used:
        raise FrameError(
            f"the first frame of the burst, {loaded[0].name}, was left out: {frames[0].reason}",
            f"Begin with a good frame: the picture is on its grid. {STACK_REMEDY}",
        )


def _grey(loaded: LoadedRaw) -> Image:
    """Return the counts (rows, cols), float32, with bad pixels at the median of the others."""
    pixels = loaded.raw.pixels if loaded.channels == 1 else loaded.raw.pixels.mean(axis=2)
    grey = np.asarray(pixels, np.float32).copy()
    grey[loaded.raw.bad] = np.median(grey[~loaded.raw.bad])
    return grey
