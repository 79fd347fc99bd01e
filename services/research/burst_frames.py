"""Raws of a burst: their common levels, which are unusable, and refusals of what is no burst.

Refused are frames that are the same exposure, PSFs given as frames, and a first frame of no use.
"""

from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256

import numpy as np
from scipy import fft

from device.config.image_files import Raw, common_white_dn
from device.errors import FrameError, SettingError
from device.recon.model.kernels import Pixels
from device.values import FrameUse, Image, Psf
from services.research.reconstruct_inputs import LoadedRaw, refuse_without_signal

LOW = (2, 5)  # cycles per shorter side of a frame
HIGH = (10, 30)
# Power at HIGH over that at LOW, of a frame over that of its PSF: a point has 1 and PSFs of other depths 0.4 to 2.4, an
# object falls with the frequency: recordings have 0.001 to 0.007, simulated frames 0.02 at 100 electrons.
PSF_LIKE = 0.1
BRIGHTEST = 0.9999  # quantile above which pixels are clipped: hot pixels have a flat spectrum
STACK_REMEDY = "Give a stack of PSFs as --psf A --psf B, or as --psf FOLDER; give each frame of a burst once."


def refuse_repeated(loaded: Sequence[LoadedRaw]) -> None:
    """Raise FrameError if two raws of a burst hold the same pixels: the noise of two exposures differs."""
    seen: dict[str, str] = {}
    for frame in loaded:
        pixels = frame.raw.pixels
        digest = f"{pixels.dtype} {sha256(pixels.tobytes()).hexdigest()}"
        if digest in seen:
            raise FrameError(
                f"{frame.name} holds the same pixels as {seen[digest]}, so it is no second exposure",
                "Give each frame of a burst once; one frame is solved alone.",
            )
        seen[digest] = frame.name


def refuse_psfs(usable: Sequence[LoadedRaw], psfs: Sequence[Psf]) -> None:
    """Raise FrameError for the first frame with the spectrum of a PSF: it shows a point, and no object."""
    if min(psfs[0].pixels.shape) < 2 * HIGH[1]:
        return  # too few samples for these frequencies
    least = PSF_LIKE * min(_fall(psf.pixels) for psf in psfs)
    for frame in usable:
        if _fall(_grey(frame)) > least:
            raise FrameError(f"{frame.name} looks like a PSF, not like a frame of a burst", STACK_REMEDY)


def _fall(image: Image) -> float:
    """Return the ratio of the mean power at the frequencies HIGH to that at LOW."""
    clipped = np.minimum(image, np.quantile(image, BRIGHTEST)).astype(np.float64)
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    spectrum = fft.rfft2((clipped - (clipped * window).sum() / window.sum()) * window)
    cycles = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1])[None]) * min(image.shape)
    low, high = (float((np.abs(spectrum[(cycles >= a) & (cycles < b)]) ** 2).mean()) for a, b in (LOW, HIGH))
    return high / max(low, 1e-30)


def refuse_without_first(loaded: Sequence[LoadedRaw], reason: str | None) -> None:
    """Raise FrameError with the reason, if the first raw was left out: the picture would be on another grid."""
    if reason is not None:
        raise FrameError(
            f"the first frame of the burst, {loaded[0].name}, was left out: {reason}",
            f"Begin with a good frame: the picture is on its grid. {STACK_REMEDY}",
        )


def _grey(loaded: LoadedRaw) -> Image:
    """Return the counts (rows, cols), float32, with bad pixels at the median of the others."""
    pixels = loaded.raw.pixels if loaded.channels == 1 else loaded.raw.pixels.mean(axis=2)
    grey = np.asarray(pixels, np.float32).copy()
    grey[loaded.raw.bad] = np.median(grey[~loaded.raw.bad])
    return grey


def unusable_raws(loaded: Sequence[LoadedRaw]) -> dict[int, str]:
    """Return the reason of each raw that holds no usable signal, by its place in the burst."""
    reasons = {}
    for k, frame in enumerate(loaded):
        try:
            refuse_without_signal(frame.raw, frame.label)
        except FrameError as error:
            reasons[k] = error.message
    return reasons


def common_raw(usable: Sequence[LoadedRaw]) -> LoadedRaw:
    """Return the first usable raw with the levels of all; the bits of a file follow from its brightest pixel.

    FrameError for raws of different shapes, colour patterns or levels, SettingError for colour raws.
    """
    first = usable[0]
    if first.channels != 1:
        raise SettingError(
            "the raws of a burst have one channel, and these have three",
            "Give the raws of each colour with its PSF: --channel NAME RAW PSF.",
        )
    for frame in usable[1:]:
        refuse_other_size(frame, first)
        if _storage(frame) != _storage(first):
            raise FrameError(
                f"{frame.name} is stored in another way than {first.name}: other levels, or other types of numbers",
                "Give the raws of one burst, saved in one format.",
            )
    white_dn = common_white_dn([frame.raw for frame in usable])
    return replace(first, raw=replace(first.raw, white_dn=white_dn, bad=np.zeros(first.solved_shape, np.bool_)))


def refuse_other_size(frame: LoadedRaw, first: LoadedRaw) -> None:
    """Raise FrameError for a frame with another size, or number of channels, than the first of its capture."""
    if (frame.shape, frame.channels) != (first.shape, first.channels):
        raise FrameError(
            f"{frame.name} has {_size(frame)}, {first.name} {_size(first)}",
            "Give the raws of one capture, in one and the same camera mode.",
        )


def _storage(raw: LoadedRaw) -> tuple[object, ...]:
    return raw.raw.shift, raw.raw.pixels.dtype, raw.black_dn


def without_bad(raw: Raw) -> Pixels:
    """Return the counts, with NaN for bad pixels if there are any."""
    if not raw.bad.any():
        return raw.pixels
    return np.where(raw.bad, np.float32(np.nan), raw.pixels.astype(np.float32))


def rejections(loaded: Sequence[LoadedRaw], frames: Sequence[FrameUse]) -> tuple[str, ...]:
    """Return a note for each raw that is not used."""
    return tuple(
        f"{frame.label} was left out: {use.reason}." for frame, use in zip(loaded, frames, strict=True) if not use.used
    )


def _size(raw: LoadedRaw) -> str:
    return f"{raw.shape[0]} x {raw.shape[1]} pixels" + (" in three channels" if raw.channels == 3 else "")
