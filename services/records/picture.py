"""Pictures for eyes, and raw frames for later: arrays to bytes and back, nothing else.

Pixels for eyes are sRGB: screens undo that curve, so the light they give off is proportional to what was reconstructed.
Without it a linear picture looks too dark in the vessels; any other curve would change their contrast.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from functools import lru_cache
from io import BytesIO
from itertools import accumulate
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from device.errors import FrameError, SettingError
from device.values import Counts, Image, check_image_shape

Pixels = NDArray[np.uint8]

MARK = "SIMULATED"
_BROKEN_TIFF = (tifffile.TiffFileError, struct.error, zlib.error)  # what tifffile lets through, wherever it is cut off
_LOW, _HIGH = 0.5, 99.8  # percent of the lit pixels: what lies outside is noise below and reflections above
_SAMPLES = 40_000  # enough to know those percentiles to a grey level, and a hundredth of the time for all of them
_DARKEST = 1e-30  # a picture that nowhere exceeds this is black, and dividing by its range would overflow
_MANY_FULL = 0.05  # of a block of pixels: then it is shown as full
_STEPS = 4096  # in linear light, finer than 8 bits of sRGB anywhere (its slope is at most 12.92)
_LETTER_RATIO = 1 / 18  # size of the mark's letters over the height of the picture: read at arm's length on a telephone
_LETTER_LEAST_PX = 12.0  # below this the letters run into each other


def to_png(picture: Image, simulated: bool, note: str = "") -> bytes:
    """A picture for eyes: 8 bits, sRGB, windowed between percentiles 0.5 and 99.8 of what is not black.

    `picture` is linear float32 (rows, cols) or (rows, cols, 3) and keeps its size; all channels share one window, so
    nothing is coloured that was not. A simulated one says so in its pixels and in a text chunk, `simulated`; `note`
    goes into a text chunk only. Raises FrameError if any value is NaN or infinite.
    """
    _refuse_no_picture(picture)
    return _png(Pillow.fromarray(_marked(_for_eyes(picture), simulated)), "true" if simulated else "false", note)


def noted(png: bytes, note: str) -> bytes:
    """The pixels of `to_png` under another note."""
    with Pillow.open(BytesIO(png)) as image:
        return _png(image, str(image.info["simulated"]), note)


def _png(image: Pillow.Image, simulated: str, note: str) -> bytes:
    chunks = PngInfo()
    chunks.add(b"sRGB", b"\0")
    chunks.add_text("simulated", simulated)
    if note:
        chunks.add_itxt("note", note)
    out = BytesIO()
    # Level 1: a noisy picture hardly shrinks further, and level 6 takes four times as long.
    image.save(out, "PNG", pnginfo=chunks, compress_level=1)
    return out.getvalue()


def to_jpeg(picture: Image, longest_side_px: int, simulated: bool, quality: int = 70) -> bytes:
    """A quick look: as `to_png`, but never longer than `longest_side_px` (nor enlarged), and lossy.

    It is made smaller in linear light, where the mean of two pixels is the light of both. Raises FrameError for values
    that are not numbers, SettingError for a size or quality (1 to 95) that cannot be.
    """
    if longest_side_px < 1 or not 1 <= quality <= 95:
        raise SettingError(f"a picture {longest_side_px} px long, at quality {quality} of 1 to 95, cannot be made")
    _refuse_no_picture(picture)
    small = _block_mean(picture, max(picture.shape[:2]) // longest_side_px)
    image = Pillow.fromarray(_for_eyes(small))
    image.thumbnail((longest_side_px, longest_side_px), Pillow.Resampling.BILINEAR)  # what whole blocks left over
    out = BytesIO()
    comment = f"simulated={'true' if simulated else 'false'}"
    Pillow.fromarray(_marked(np.asarray(image), simulated)).save(out, "JPEG", quality=quality, comment=comment)
    return out.getvalue()


def counts_jpeg(counts: Counts, black_dn: float, white_dn: float, longest_side_px: int, simulated: bool) -> bytes:
    """What the sensor sees, uint16 (rows, cols): black at `black_dn`, white at `white_dn`, full pixels are red."""
    smaller = max(counts.shape) // longest_side_px
    share = (_block_mean(counts.astype(np.float32), smaller) - black_dn) / (white_dn - black_dn)
    grey = _srgb_curve().take((np.clip(share, 0, 1) * (_STEPS - 1)).astype(np.uint16))
    full = _block_mean((counts >= white_dn).astype(np.float32), smaller) > _MANY_FULL
    pixels = np.stack([np.where(full, 255, grey), *[np.where(full, 0, grey)] * 2], -1).astype(np.uint8)
    out = BytesIO()
    Pillow.fromarray(_marked(pixels, simulated)).save(out, "JPEG", quality=80)
    return out.getvalue()


def raw_tiff(counts: Counts, description: Mapping[str, Any]) -> bytes:
    """A frame as a 16-bit TIFF, lossless (deflate), with `description` as JSON in ImageDescription.

    `counts` is uint16 (rows, cols) or (rows, cols, 3). Raises FrameError for other arrays, SettingError for a
    description that is not JSON.
    """
    check_image_shape(counts.shape)
    if counts.dtype != np.uint16:
        raise FrameError(f"a raw frame holds uint16 counts, not {counts.dtype}")
    try:
        text = json.dumps(dict(description), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SettingError(f"the description of a raw frame cannot be written down: {error}") from error
    out = BytesIO()
    tifffile.imwrite(
        out,
        counts,
        photometric="rgb" if counts.ndim == 3 else "minisblack",
        compression="zlib",  # level 1: sensor noise does not shrink further, and it must be fast on a Pi
        compressionargs={"level": 1},
        description=text,
        metadata=None,
    )
    return out.getvalue()


def read_raw_tiff(data: bytes) -> tuple[Counts, dict[str, Any]]:
    """The counts and the description that `raw_tiff` was given; FrameError for anything it did not write."""
    try:
        with tifffile.TiffFile(BytesIO(data)) as tiff:
            page = tiff.pages.first
            counts, description = page.asarray(), json.loads(page.description)
    except (*_BROKEN_TIFF, ValueError, OSError, LookupError) as error:
        raise FrameError(f"this is not a whole raw TIFF: {error}") from error
    if counts.dtype != np.uint16 or not isinstance(description, dict):
        raise FrameError(f"this TIFF holds {counts.dtype}, and no description of a raw frame")
    return counts, description


def _refuse_no_picture(picture: Image) -> None:
    check_image_shape(picture.shape)
    if not np.isfinite(picture).all():
        raise FrameError("the picture holds values that are not numbers (NaN or infinite)")


def _for_eyes(picture: Image) -> Pixels:
    """8-bit sRGB of the same shape."""
    low, high = _window(picture)
    scaled = np.subtract(picture, low, dtype=np.float32)
    scaled *= np.float32((_STEPS - 1) / (high - low))
    np.clip(scaled, 0, _STEPS - 1, out=scaled)
    scaled += np.float32(0.5)
    pixels: Pixels = _srgb_curve().take(scaled.astype(np.uint16))
    return pixels


def _window(picture: Image) -> tuple[float, float]:
    """What becomes black and what becomes white: robust percentiles of the part that is not exactly zero.

    A reconstruction is zero outside the illuminated disc; counting that would make the window depend on its size.
    """
    step = max(1, int(np.sqrt(picture.size / _SAMPLES)))
    sample = picture[::step, ::step]
    lit = sample[sample != 0]
    if not lit.size or not np.abs(lit).max() > _DARKEST:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(lit, (_LOW, _HIGH)))
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # one even grey: show it against the black around it
        low, high = min(low, 0.0), max(high, 0.0)
    return low, high


@lru_cache(maxsize=1)
def _srgb_curve() -> Pixels:
    """8-bit sRGB for each of `_STEPS` levels of linear light (IEC 61966-2-1)."""
    linear = np.linspace(0, 1, _STEPS)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    pixels: Pixels = np.rint(255 * curve).astype(np.uint8)
    return pixels


def _block_mean(picture: Image, block: int) -> Image:
    """The picture made smaller by a whole number, by the mean of each block; a last part of a block is left out."""
    if block < 2:
        return picture
    down, across = (
        min(block, length) for length in picture.shape[:2]
    )  # a very long picture may be thinner than a block
    rows, cols = picture.shape[0] // down * down, picture.shape[1] // across * across
    strips = sum((picture[row:rows:down] for row in range(1, down)), start=picture[0:rows:down])
    total = sum((strips[:, col:cols:across] for col in range(1, across)), start=strips[:, 0:cols:across])
    return np.asarray(total / np.float32(down * across), np.float32)


def _marked(pixels: Pixels, simulated: bool) -> Pixels:
    """The pixels with the mark in the bottom left corner, if what they show was simulated."""
    if not simulated:
        return pixels
    band = _band(*pixels.shape[:2])
    rows, cols = band.shape
    marked = pixels.copy()
    marked[-rows:, :cols] = band if pixels.ndim == 2 else band[..., np.newaxis]
    return marked


@lru_cache(maxsize=8)
def _band(rows: int, cols: int) -> Pixels:
    """The mark, white on black, for a picture of that size; on one too small for its letters, as much as there is."""
    size = max(_LETTER_LEAST_PX, rows * _LETTER_RATIO)
    size = max(1.0, size * min(1.0, cols / _lengths(size)[-1]))
    font, ends = ImageFont.load_default(size), _lengths(size)
    width, height = min(cols, round(ends[-1])), min(rows, round(1.25 * size))
    band = Pillow.new("L", (width, height), 0)
    for letter, end in zip(MARK, ends, strict=False):  # the last end is the margin's
        ImageDraw.Draw(band).text((end, height / 2), letter, fill=255, font=font, anchor="rm")
    return np.asarray(band)


def _lengths(size: float) -> list[float]:
    """Where each letter of the mark ends, and the band last; a gap between letters keeps small ones apart."""
    font, gap = ImageFont.load_default(size), 0.15 * size
    ends = list(accumulate((font.getlength(letter) + gap for letter in MARK), initial=0.3 * size))
    return [*ends[1:], ends[-1] + 0.45 * size]
