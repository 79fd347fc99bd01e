"""Levels, areas and colour filter pattern that a DNG states about its raw image (Adobe DNG Specification 1.7).

In the order of the specification: linearisation table, active area, black levels, default crop, orientation. The
pattern and the black levels count from the corner of the active area.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from device.config.bayer import PATTERNS, Bayer
from device.config.orientation import upright
from device.errors import FrameError

Pixels = NDArray[Any]
SAVE_MOSAIC = "Save its mosaic as tiff or npy."


@dataclass(frozen=True)
class Levels:
    """Pattern, black and white level of a raw image, in counts after its linearisation; None if not stated."""

    bayer: Bayer | None = None
    black_dn: float | None = None
    white_dn: float | None = None


NOT_STATED = Levels()


def tag_values(tag: tifffile.TiffTag | None) -> tuple[float, ...]:
    """Return the values of a tag, fractions divided; empty for a missing tag."""
    if tag is None:
        return ()
    value = tag.value  # a number, bytes, or a sequence of numbers
    values = tuple(float(number) for number in (value if isinstance(value, bytes) else np.ravel(value)))
    if tag.dtype in (tifffile.DATATYPE.RATIONAL, tifffile.DATATYPE.SRATIONAL):
        return tuple(top / bottom for top, bottom in zip(values[::2], values[1::2], strict=True))
    return values


def with_dng_levels(page: tifffile.TiffPage, stored: Pixels, orientation: int, name: str) -> tuple[Pixels, Levels]:
    """Return the upright counts of a raw page, and the levels that hold for all of them.

    FrameError names a tag that cannot be applied.
    """
    pixels = _linearised(page, stored, name)
    top, left, bottom, right = _whole(page, "ActiveArea", (0, 0, *pixels.shape[:2]), name)
    pixels = _cut(pixels, (top, left, bottom - top, right - left), "ActiveArea", name)
    white = _white(page, name)
    pixels, black = _without_black_pattern(page, pixels, white, name)
    if white is not None and black is not None and white <= black:
        raise FrameError(f"{name} has the WhiteLevel {white:g} below the BlackLevel {black:g}", SAVE_MOSAIC)
    filters = _filters(page, name)
    origin = _whole(page, "DefaultCropOrigin", (0, 0), name)
    crop = _whole(page, "DefaultCropSize", (pixels.shape[1], pixels.shape[0]), name)
    pixels = _cut(pixels, (origin[1], origin[0], crop[1], crop[0]), "DefaultCropOrigin and DefaultCropSize", name)
    if filters is None:
        return upright(pixels, orientation, name), Levels(None, black, white)
    rows, cols = pixels.shape[:2]
    odd = np.roll(filters, (-(origin[1] % 2), -(origin[0] % 2)), (0, 1))
    letters = upright(np.tile(odd, (2, 2))[: 2 + rows % 2, : 2 + cols % 2], orientation, name)[:2, :2]
    pattern = "".join(letters.ravel())
    known = next((known for known in PATTERNS if known == pattern), None)
    return upright(pixels, orientation, name), Levels(known, black, white)


def _linearised(page: tifffile.TiffPage, stored: Pixels, name: str) -> Pixels:
    """Return the values that the linearisation table gives for the stored ones; the last entry holds beyond its end."""
    table = page.tags.get("LinearizationTable")
    if table is None:
        return stored
    if stored.dtype.kind != "u":
        raise FrameError(f"{name} has a LinearizationTable for values of type {stored.dtype}", SAVE_MOSAIC)
    entries = np.asarray(tag_values(table), np.uint16)
    return entries[np.minimum(stored, len(entries) - 1)]


def _white(page: tifffile.TiffPage, name: str) -> float | None:
    """Return the saturation level; None if not stated."""
    white = tag_values(page.tags.get("WhiteLevel"))
    if len(set(white)) > 1 or min(white, default=1) <= 0:
        raise FrameError(f"{name} has the WhiteLevel {', '.join(f'{level:g}' for level in white)}", SAVE_MOSAIC)
    return white[0] if white else None


def _without_black_pattern(
    page: tifffile.TiffPage, pixels: Pixels, white: float | None, name: str
) -> tuple[Pixels, float | None]:
    """Return counts above one black level for all pixels, and this level: the lowest of the stated ones.

    The differences of the others to it are subtracted, rounded for whole counts. A saturated count stays at the white
    level.
    """
    rows, cols, *channels = pixels.shape
    black = tag_values(page.tags.get("BlackLevel"))
    across = tag_values(page.tags.get("BlackLevelDeltaH")) or (0.0,) * cols
    down = tag_values(page.tags.get("BlackLevelDeltaV")) or (0.0,) * rows
    repeat_rows, repeat_cols = _whole(page, "BlackLevelRepeatDim", (1, 1), name)
    count = repeat_rows * repeat_cols * (channels[0] if channels else 1)
    fitting = len(black) == count or len(set(black)) <= 1
    if len(across) != cols or len(down) != rows or not fitting or count < 1:
        raise FrameError(
            f"{name} has {len(black)} values of BlackLevel (BlackLevelRepeatDim {repeat_rows} x {repeat_cols}), "
            f"{len(across)} of BlackLevelDeltaH and {len(down)} of BlackLevelDeltaV, which do not fit its image",
            SAVE_MOSAIC,
        )
    if len(set(black)) <= 1 and not any(across) and not any(down):
        return pixels, black[0] if black else None
    values = black if len(black) == count else (*black, 0.0)[:1] * count
    tile = np.reshape(values, (repeat_rows, repeat_cols, -1))
    levels = tile[np.arange(rows) % repeat_rows][:, np.arange(cols) % repeat_cols]
    levels = levels + np.asarray(across)[None, :, None] + np.asarray(down)[:, None, None]
    base = float(levels.min())
    excess = (levels - base).reshape(pixels.shape)
    if pixels.dtype.kind == "f":
        return (pixels - excess).astype(np.float32), base
    lower = np.maximum(pixels - np.rint(excess), 0)
    full = 2.0 ** int(page.bitspersample) - 1 if white is None else white
    return np.where(pixels >= full, pixels, lower).astype(pixels.dtype), base


def _filters(page: tifffile.TiffPage, name: str) -> NDArray[np.str_] | None:
    """Return the letters r, g, b of the colour filters of a 2 x 2 block; None for a raw image without filters."""
    if page.photometric != tifffile.PHOTOMETRIC.CFA:
        return None
    values = [int(value) for value in tag_values(page.tags.get("CFAPattern"))]
    repeat = _whole(page, "CFARepeatPatternDim", (2, 2), name)
    if len(set(values)) <= 1:  # not stated, or one filter for all
        return None
    letters = "".join("rgb"[value] if value < 3 else "?" for value in values)
    if repeat != (2, 2) or letters not in PATTERNS:
        raise FrameError(
            f"{name} is a mosaic of another kind: CFAPattern {letters}, CFARepeatPatternDim {repeat[0]} x {repeat[1]}",
            "Save it as a mosaic of red, green, green and blue in 2 x 2 pixels, or as a colour picture.",
        )
    return np.reshape(list(letters), (2, 2))


def _whole(page: tifffile.TiffPage, tag: str, default: tuple[int, ...], name: str) -> tuple[int, ...]:
    """Return the whole numbers of a tag; FrameError for fractions, or for another number of values."""
    values = tag_values(page.tags.get(tag)) or default
    if len(values) != len(default) or any(value != int(value) for value in values):
        raise FrameError(
            f"{name} has {tag} {', '.join(f'{number:g}' for number in values)}, which is not read", SAVE_MOSAIC
        )
    return tuple(int(value) for value in values)


def _cut(pixels: Pixels, area: tuple[int, int, int, int], tag: str, name: str) -> Pixels:
    """Return the area (top, left, rows, cols) of an image; FrameError if it does not lie inside."""
    top, left, rows, cols = area
    if min(top, left) < 0 or min(rows, cols) < 1 or top + rows > pixels.shape[0] or left + cols > pixels.shape[1]:
        raise FrameError(f"{name} has {tag} of {rows} x {cols} pixels outside its image", SAVE_MOSAIC)
    return pixels[top : top + rows, left : left + cols]
