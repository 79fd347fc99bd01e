"""Image files in and out: tiff, png and npy, with a clear word about every file that is not an image."""

import json
import struct
import zipfile
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from device.errors import FrameError, PsfError, SettingError
from device.values import Image, Mask, Psf, check_image_shape

SUFFIXES = (".tif", ".tiff", ".png", ".npy")
MOST_PIXELS = 2**27  # a quarter of a gigabyte of counts: more is a mistake or an attack
DENSEST = 1100  # no deflated black frame is larger than this many times its file (zlib: 1032)
_BROKEN = (  # what the decoders let through, wherever a file is cut off or damaged
    ValueError, EOFError, OSError, SyntaxError, LookupError, TypeError, ArithmeticError, MemoryError, AssertionError,
    NotImplementedError,    UnidentifiedImageError, tifffile.TiffFileError,
    Pillow.DecompressionBombError, struct.error, zlib.error, zipfile.BadZipFile, TokenError,
)  # fmt: skip


def read_image(path: Path) -> NDArray[Any]:
    """The numbers of an image file, (rows, cols) or (rows, cols, 3), uint8, uint16 or float as stored.

    An alpha channel is dropped. Raises FrameError for what is missing, empty, truncated, or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(
            f"{path} cannot be read: {error.strerror}", "Give the path of a readable image file."
        ) from error
    if not data:
        raise FrameError(f"{path} is empty", "Copy the file again; the copy was interrupted.")
    array = np.asarray(_decode(path, data))
    if array.ndim == 3 and array.shape[2] == 4:
        array = array[..., :3]
    try:
        check_image_shape(array.shape)
    except FrameError as error:
        raise FrameError(f"{path}: {error.message}") from error
    if array.dtype.kind not in "ufi" or array.size > 3 * MOST_PIXELS:
        raise FrameError(f"{path} holds {array.size} values of type {array.dtype}, which is no raw image")
    return array


def _decode(path: Path, data: bytes) -> NDArray[Any]:
    try:
        match path.suffix.lower():
            case ".npy":
                return np.asarray(np.load(BytesIO(data), allow_pickle=False))
            case ".tif" | ".tiff":
                return _decode_tiff(data)
            case ".png":
                _refuse_what_would_lose_bits(path, data)
                with Pillow.open(BytesIO(data)) as picture:
                    picture.load()
                    return np.asarray(picture.convert("RGB") if picture.mode in ("P", "LA") else picture)
    except _BROKEN as error:
        raise FrameError(f"{path} is not a whole {path.suffix[1:]} image: {error or 'too large'}") from error
    raise FrameError(f"{path}: the ending '{path.suffix}' is not one of {', '.join(SUFFIXES)}")


def _decode_tiff(data: bytes) -> NDArray[Any]:
    """Refuse first what the file cannot hold: a damaged header would cost minutes and all the memory."""
    with tifffile.TiffFile(BytesIO(data)) as tiff:
        promised_bytes = tiff.series[0].nbytes
        if promised_bytes > DENSEST * len(data) or tiff.series[0].size > 3 * MOST_PIXELS:
            raise ValueError(f"{len(data)} bytes cannot hold the {promised_bytes} that it promises")
        return np.asarray(tiff.asarray())


def _refuse_what_would_lose_bits(path: Path, data: bytes) -> None:
    """A png of 16-bit colour: our decoder would keep 8 bits of each, and say nothing."""
    depth, colour = data[24:25], data[25:26]  # of the header, which the format fixes
    if data[1:4] == b"PNG" and depth == b"\x10" and colour in b"\x02\x04\x06":
        raise FrameError(f"{path} holds 16-bit colour, which a png here cannot bring whole", "Save it as tiff or npy.")


def says_simulated(path: Path) -> bool:
    """Whether a raw tiff says in its description that no retina was there, as those that we keep do."""
    try:
        with tifffile.TiffFile(path) as tiff:
            facts = json.loads(tiff.pages.first.description)
    except (*_BROKEN, AttributeError):  # not a tiff, or one without such a description
        return False
    return isinstance(facts, dict) and facts.get("simulated") is True


def write_linear(path: Path, picture: Image) -> None:
    """Write linear float32 as `.npy` or `.tiff`, as the ending says."""
    match path.suffix.lower():
        case ".npy":
            np.save(path, picture)
        case ".tif" | ".tiff":
            tifffile.imwrite(path, picture, photometric="rgb" if picture.ndim == 3 else "minisblack")
        case other:
            raise SettingError(f"{path}: linear pictures are written as .npy or .tiff, not '{other}'")


@dataclass(frozen=True)
class Raw:
    """A raw file as the solver wants it: uint16 counts or float32, (rows, cols) or (rows, cols, 3).

    `white_dn` is where it saturates (infinite for float), `bad` the pixels that hold no image, `shift` how many bits a
    left-justified converter was moved back, `stored_bits` how many bits the file has for a pixel.
    """

    pixels: NDArray[np.uint16] | NDArray[np.float32]
    white_dn: float
    bad: Mask
    shift: int
    stored_bits: int


def as_raw(array: NDArray[Any]) -> Raw:
    """Bring counts of any kind to one kind.

    12-bit data in 16-bit words are often moved left by 4 bits: then every count is a multiple of 16, and the few that
    are not hold no image (the DiffuserCam tutorial's first two). NaN and infinite values are bad pixels too.
    """
    if array.dtype.kind == "f":
        strange = ~np.isfinite(array)
        return Raw(
            np.where(strange, 0, array).astype(np.float32), float("inf"), _any_channel(strange), 0, 8 * array.itemsize
        )
    if array.dtype.kind == "i" and array.size and array.min() < 0:
        raise FrameError("this image holds negative whole numbers, which no sensor counts")
    if array.max() > 65535:
        raise FrameError(f"this image counts up to {array.max()}, more than 16 bits", "Give counts of at most 16 bits.")
    counts = array.astype(np.uint16)
    shift, stray = _justification(counts)
    counts = counts >> np.uint16(shift)
    bad = _any_channel(stray)
    top = int(counts[~bad].max()) if not bad.all() else 0
    bits = next(bits for bits in (8, 10, 12, 14, 16) if top < 2**bits)
    return Raw(counts, float(2**bits - 1), bad, shift, 8 * array.itemsize)


def _any_channel(mask: Mask) -> Mask:
    return mask if mask.ndim == 2 else np.logical_or.reduce(mask, axis=2)


def _justification(counts: NDArray[np.uint16]) -> tuple[int, Mask]:
    lit = int(np.count_nonzero(counts))  # zeros fit every justification, and prove none
    for shift in (8, 6, 4, 2):
        stray = (counts & np.uint16(2**shift - 1)) != 0
        if stray.sum() <= 1e-4 * lit and (counts[~stray] >> shift).max(initial=0) > 255:
            return shift, stray
    return 0, np.zeros(counts.shape, np.bool_)


def as_psf(array: NDArray[Any], name: str) -> Psf:
    """A measured PSF image as a Psf: bit justification undone, non-image pixels and the border's pedestal removed.

    A pedestal of mass beta makes every picture (1 + beta) times too bright away from its mean (optics.md 5.4, 6), so
    the median of the outermost pixels is taken off; what is left below zero stays: clipping would add mass again.
    Colour PSFs are averaged. Raises PsfError for NaN, infinite values, or a sum that is not positive.
    """
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise PsfError(f"{name} holds values that are not numbers (NaN or infinite)")
    try:
        raw = as_raw(array)
    except FrameError as error:
        raise PsfError(f"{name}: {error.message}") from error
    pixels = raw.pixels.astype(np.float32)
    if pixels.ndim == 3:
        pixels = pixels.mean(axis=2)
    good = ~raw.bad
    edge = max(1, min(pixels.shape) // 50)
    border = np.ones(pixels.shape, np.bool_)
    border[edge:-edge, edge:-edge] = False
    pedestal = float(np.median(pixels[border & good])) if (border & good).any() and min(pixels.shape) > 8 else 0.0
    pixels = np.where(good, pixels - np.float32(pedestal), np.float32(0))
    return Psf(pixels, name)


def refuse_other_sizes(psfs: tuple[Psf, ...], shape: tuple[int, int]) -> None:
    """Refuse PSFs that were not measured on the raw's own pixels: of another camera mode, they are of another scale."""
    for psf in psfs:
        if psf.shape != shape:
            raise PsfError(
                f"{psf.name} has {psf.shape[0]} x {psf.shape[1]} pixels, the raw {shape[0]} x {shape[1]}",
                "Give the PSF that was measured in the same camera mode as the raw.",
            )


def read_psf(path: Path) -> Psf:
    """The PSF in an image file, cleaned as `as_psf` does."""
    try:
        array = read_image(path)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error
    return as_psf(array, path.name)
