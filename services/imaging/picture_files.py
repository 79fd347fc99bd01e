"""Encoding and decoding of arrays: display pictures (PNG, JPEG) and raw frames (16-bit TIFF).

Display pixels are sRGB-encoded: a screen inverts that curve, so its luminance is proportional to the linear picture.
Linear pixels would show vessels too dark; any other curve would change their contrast.
"""

import json
import struct
import zlib
from collections.abc import Sequence
from functools import lru_cache
from io import BytesIO

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow

from device.config.marked_files import jpeg_bytes, png_bytes, stated_in, tiff_bytes, with_band, without_band
from device.errors import FrameError, SettingError
from device.recon.model.resampling import block_mean
from device.values import Counts, Image, check_image_shape
from services.imaging.raw_metadata import RawMetadata, metadata_entries, read_metadata

Pixels = NDArray[np.uint8]

PREDICTED = "PREDICTED"
_PREDICTED_TEXT = "predicted"  # text chunk
_BROKEN_TIFF = (tifffile.TiffFileError, struct.error, zlib.error)  # exceptions of tifffile on truncated data
_LOW, _HIGH = 0.5, 99.8  # percentiles of the lit pixels: noise below, reflections above
_SAMPLES = 40_000  # error of the percentiles below a grey level, in 1 % of the time for all pixels
DISPLAY = (0.0, 1.0)  # window of a picture that is rendered for the display already
_BLACK_LIMIT = 1e-30  # a picture below this is black; a division by its range would overflow
_SATURATED_SHARE = 0.05  # of the pixels of a block: the block is shown as saturated
_STEPS = 4096  # in linear light, finer than 8 bits of sRGB anywhere (its slope is at most 12.92)
_PREDICTED_RATIO = 1 / 32  # of the mark of predicted channels


def to_png(
    picture: Image,
    simulated: bool,
    note: str = "",
    predicted: Sequence[str] = (),
    window: tuple[float, float] | None = None,
) -> bytes:
    """Return an 8-bit sRGB PNG; black and white are the values of `window`, None: those of `display_window`.

    `picture` is linear float32 (rows, cols) or (rows, cols, 3) and keeps its size; all channels share one window, which
    preserves neutral colours. A simulated picture carries a mark in its pixels and the text chunk `simulated`; `note`
    becomes a text chunk. So do `predicted` channels, which were not measured: mark in the top right corner, which the
    other mark never reaches, and text chunk `predicted`. Raises FrameError if any value is NaN or infinite.
    """
    _refuse_invalid_picture(picture)
    pixels = _display_pixels(picture, window)
    texts = {}
    if predicted:
        texts = {_PREDICTED_TEXT: ", ".join(predicted)}
        pixels = with_band(pixels, f"{' + '.join(predicted).upper()} {PREDICTED}", _PREDICTED_RATIO, top_right=True)
    return png_bytes(pixels, simulated, texts, note)


def with_note(png: bytes, note: str) -> bytes:
    """Return a PNG of `to_png` with another note and the same pixels."""
    with Pillow.open(BytesIO(png)) as image:
        texts = {name: str(image.info[name]) for name in (_PREDICTED_TEXT,) if name in image.info}
        simulated = stated_in("picture.png", BytesIO(png)) is True
        return png_bytes(np.asarray(image), simulated, texts, note, for_eyes=False)  # they have their marks


def to_jpeg(
    picture: Image,
    longest_side_px: int,
    simulated: bool,
    quality: int = 70,
    window: tuple[float, float] | None = None,
) -> bytes:
    """Return an 8-bit sRGB JPEG with the window and mark of `to_png`, never enlarged.

    Its longer side is at most `longest_side_px`; the reduction in linear light preserves the mean. Raises FrameError
    for NaN or infinite values, SettingError for a size below 1 or a quality outside 1 to 95.
    """
    if longest_side_px < 1 or not 1 <= quality <= 95:
        raise SettingError(f"a picture {longest_side_px} px long, at quality {quality} of 1 to 95, cannot be made")
    _refuse_invalid_picture(picture)
    small = block_mean(picture, max(picture.shape[:2]) // longest_side_px)
    image = Pillow.fromarray(_display_pixels(small, window))
    image.thumbnail(
        (longest_side_px, longest_side_px), Pillow.Resampling.BILINEAR
    )  # remaining reduction below a factor of two
    return jpeg_bytes(np.asarray(image), simulated, quality)


def counts_jpeg(counts: Counts, black_dn: float, white_dn: float, longest_side_px: int, simulated: bool) -> bytes:
    """Return a JPEG of raw counts, uint16 (rows, cols): sRGB grey from `black_dn` to `white_dn`, saturated blocks red.

    Reduced by a whole factor, so its longer side is below twice `longest_side_px`. Marked if `simulated`.
    """
    smaller = max(counts.shape) // longest_side_px
    share = (block_mean(counts.astype(np.float32), smaller) - black_dn) / (white_dn - black_dn)
    grey = _srgb_curve().take((np.clip(share, 0, 1) * (_STEPS - 1)).astype(np.uint16))
    full = block_mean((counts >= white_dn).astype(np.float32), smaller) > _SATURATED_SHARE
    pixels = np.stack([np.where(full, 255, grey), *[np.where(full, 0, grey)] * 2], -1).astype(np.uint8)
    return jpeg_bytes(pixels, simulated, 80)


def raw_tiff(counts: Counts, metadata: RawMetadata) -> bytes:
    """Return a lossless 16-bit TIFF (deflate) with `metadata` as JSON in the tag ImageDescription.

    `counts` is uint16 (rows, cols) or (rows, cols, 3). Raises FrameError for other arrays, SettingError for an
    exposure time that is NaN or infinite.
    """
    check_image_shape(counts.shape)
    if counts.dtype != np.uint16:
        raise FrameError(f"a raw frame holds uint16 counts, not {counts.dtype}")
    return tiff_bytes(counts, metadata.simulated, metadata_entries(metadata), deflated=True)


def read_raw_tiff(data: bytes) -> tuple[Counts, RawMetadata]:
    """Return counts and metadata of a TIFF written by `raw_tiff`; FrameError for any other data."""
    try:
        with tifffile.TiffFile(BytesIO(data)) as tiff:
            page = tiff.pages.first
            counts = page.asarray()
            description = json.loads(page.description)
    except (*_BROKEN_TIFF, ValueError, OSError, LookupError) as error:
        raise FrameError(f"this is not a whole raw TIFF: {error}") from error
    if counts.dtype != np.uint16 or not isinstance(description, dict):
        raise FrameError(f"this TIFF holds {counts.dtype}, and no description of a raw frame")
    return counts, read_metadata(description)


def _refuse_invalid_picture(picture: Image) -> None:
    check_image_shape(picture.shape)
    if not np.isfinite(picture).all():
        raise FrameError("the picture holds values that are not numbers (NaN or infinite)")


def _display_pixels(picture: Image, window: tuple[float, float] | None) -> Pixels:
    """Return the 8-bit sRGB pixels of a linear picture, same shape, scaled to a window; None: `display_window`."""
    low, high = window or display_window(picture)
    scaled = np.subtract(picture, low, dtype=np.float32)
    scaled *= np.float32((_STEPS - 1) / (high - low))
    np.clip(scaled, 0, _STEPS - 1, out=scaled)
    scaled += np.float32(0.5)
    pixels: Pixels = _srgb_curve().take(scaled.astype(np.uint16))
    return pixels


def display_window(picture: Image) -> tuple[float, float]:
    """Return the values shown as black and as white: percentiles 0.5 and 99.8 of the pixels that are not zero.

    (0, 1) if all are zero.

    A reconstruction is zero outside the illuminated disc; these pixels would make the window depend on its size.
    """
    step = max(1, int(np.sqrt(picture.size / _SAMPLES)))
    sample = picture[::step, ::step]
    lit = sample[sample != 0]
    if not lit.size or not np.abs(lit).max() > _BLACK_LIMIT:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(lit, (_LOW, _HIGH)))
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # uniform grey: the window includes zero
        low = min(low, 0.0)
        high = max(high, 0.0)
    return low, high


@lru_cache(maxsize=1)
def _srgb_curve() -> Pixels:
    """Return the lookup table from `_STEPS` levels of linear light to 8-bit sRGB (IEC 61966-2-1)."""
    linear = np.linspace(0, 1, _STEPS)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    pixels: Pixels = np.rint(255 * curve).astype(np.uint8)
    return pixels


def read_png(png: bytes) -> Image:
    """Return the linear light, 0 to 1, of a picture that `to_png` wrote, float32 (rows, cols) or (rows, cols, 3).

    The mark of a simulated picture is replaced by 0. FrameError for other data.
    """
    try:
        with Pillow.open(BytesIO(png)) as image:
            pixels = np.asarray(image)
    except (OSError, ValueError, SyntaxError) as error:  # SyntaxError: Pillow, for a damaged PNG
        raise FrameError(f"this is not a whole PNG: {error}") from error
    light = from_srgb(pixels)
    return without_band(light) if stated_in("picture.png", BytesIO(png)) else light


def from_srgb(pixels: NDArray[np.uint8]) -> Image:
    """Return the linear light, 0 to 1, of 8-bit sRGB values of any shape (IEC 61966-2-1)."""
    coded = pixels.astype(np.float32) / np.float32(255)
    return np.asarray(np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4), np.float32)
