"""Files of pictures with the mark of those that show no real eye: the one reader, and the one writer of pictures.

Every encoder takes `simulated`, so no picture is written without a decision. Where the mark is:

    .png .jpg   text chunk or comment `simulated`; in pictures for eyes also a band of letters in the pixels
    .tiff .dng  key `simulated` of the JSON in ImageDescription
    .npy .npz   key `simulated` of the side file NAME.json, or of the manifest.toml of an archived calibration
    .json       key `simulated`
    .zip        marked if a file in it is
"""

import io
import json
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from device.errors import SettingError
from device.values import Image

KEY, LETTERS, MANIFEST = "simulated", "SIMULATED", "manifest.toml"
_LETTER_RATIO = 1 / 18  # letter size of the band over picture height: legible on a telephone at arm's length
_LETTER_MIN_PX = 12.0  # smaller letters touch each other
_WORDS = {True: "true", False: "false"}
_UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    SyntaxError,
    EOFError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
    tifffile.TiffFileError,
    Pillow.DecompressionBombError,
)

Pixels = NDArray[np.uint8]
Stated = bool | None  # what a file states: simulated, not simulated, or nothing


def png_bytes(
    pixels: Pixels, simulated: bool, texts: Mapping[str, str] | None = None, note: str = "", *, for_eyes: bool = True
) -> bytes:
    """Return a marked PNG of 8-bit sRGB pixels, (rows, cols) or (rows, cols, 3), with text chunks and a note.

    Without `for_eyes` (masks and copies) the pixels are kept as they are.
    """
    chunks = PngInfo()
    chunks.add(b"sRGB", b"\0")
    for name, text in ({KEY: _WORDS[simulated]} | dict(texts or {})).items():
        chunks.add_text(name, text)
    if note:
        chunks.add_itxt("note", note)
    out = io.BytesIO()
    # Level 1: level 6 takes four times as long and hardly shrinks a noisy picture further.
    shown = Pillow.fromarray(marked_pixels(pixels, simulated and for_eyes))
    shown.save(out, "PNG", pnginfo=chunks, compress_level=1)
    return out.getvalue()


def jpeg_bytes(pixels: Pixels, simulated: bool, quality: int) -> bytes:
    """Return a marked JPEG of 8-bit sRGB pixels, (rows, cols) or (rows, cols, 3); `quality` 1 to 95."""
    out = io.BytesIO()
    comment = f"{KEY}={_WORDS[simulated]}"
    Pillow.fromarray(marked_pixels(pixels, simulated)).save(out, "JPEG", quality=quality, comment=comment)
    return out.getvalue()


def tiff_bytes(
    array: NDArray[Any], simulated: Stated, entries: Mapping[str, object] | None = None, *, deflated: bool = False
) -> bytes:
    """Return a marked TIFF of an array, (rows, cols) or (rows, cols, 3), lossless, with JSON `entries`.

    `simulated` None states nothing. SettingError for an entry that is NaN or infinite.
    """
    try:
        description = json.dumps(dict(entries or {}) | {KEY: simulated}, allow_nan=False)
    except ValueError as error:
        raise SettingError(f"the description of a raw frame cannot be written down: {error}") from error
    out = io.BytesIO()
    # Level 1: fast on a Raspberry Pi; sensor noise does not shrink further.
    packing: dict[str, Any] = {"compression": "zlib", "compressionargs": {"level": 1}} if deflated else {}
    kind = "rgb" if array.ndim == 3 else "minisblack"
    tifffile.imwrite(out, array, photometric=kind, description=description, metadata=None, **packing)
    return out.getvalue()


def write_npy(path: Path, array: NDArray[Any], simulated: bool) -> None:
    """Write an array as npy with its side file; OSError if a file cannot be written."""
    np.save(path, array, allow_pickle=False)
    write_side_file(path, simulated)


def write_side_file(path: Path, simulated: bool, opener: Callable[[str, int], int] | None = None) -> None:
    """Write the side file NAME.json of the npy file `path`; OSError if it cannot be written. `opener` as of `open`."""
    with open(side_file(path), "w", encoding="utf-8", opener=opener) as file:
        file.write(json.dumps({KEY: simulated}) + "\n")


def side_file(path: Path) -> Path:
    """Return the path of the side file of an npy or npz file."""
    return path.with_name(f"{path.name}.json")


def write_linear(path: Path, picture: Image, simulated: bool) -> None:
    """Write a linear float32 picture as `.npy`, `.tif` or `.tiff`, by the suffix; SettingError for another suffix."""
    match path.suffix.lower():
        case ".npy":
            write_npy(path, picture, simulated)
        case ".tif" | ".tiff":
            path.write_bytes(tiff_bytes(picture, simulated))
        case other:
            raise SettingError(f"{path}: linear pictures are written as .npy or .tiff, not '{other}'")


def is_marked_simulated(path: Path) -> bool:
    """Return true if a file states that it is simulated, as all files of the simulator do; else false."""
    return stated_mark(path) is True


def stated_mark(path: Path) -> Stated:
    """Return what a file states; None if it states nothing, cannot be read, or does not exist."""
    if ".npz:" in path.name:  # FILE.npz:NAME names an array of a file
        path = path.with_name(path.name.rpartition(":")[0])
    sides = [side_file(path), path.with_name(MANIFEST)] if path.suffix.lower() in (".npy", ".npz") else [path]
    for side in sides:
        try:
            with side.open("rb") as content:
                return stated_in(side.name, content)
        except OSError:
            continue
    return None


def unstated_notes(paths: Sequence[Path]) -> tuple[str, ...]:
    """Return a sentence for each npy or npz file that states nothing, as its format has no room for the mark."""
    silent = [path for path in paths if ".np" in path.suffix.lower() and stated_mark(path) is None]
    return tuple(
        f"{path.name} has no side file {side_file(path).name} that says whether it is simulated; it counts as not "
        "simulated."
        for path in silent
    )


def stated_in(name: str, content: BinaryIO) -> Stated:
    """Return what the content of a file of this name states; None if it states nothing or cannot be read."""
    try:
        match Path(name).suffix.lower():
            case ".png":
                with Pillow.open(content) as image:
                    return _word(image.info.get(KEY))
            case ".jpg" | ".jpeg":
                with Pillow.open(content) as image:
                    return _word(image.info.get("comment"))
            case ".tif" | ".tiff" | ".dng":
                with tifffile.TiffFile(content) as tiff:
                    return stated_by(json.loads(tiff.pages.first.description))
            case ".json":
                return stated_by(json.load(content))
            case ".toml":
                return stated_by(tomllib.load(content))
            case ".zip":
                with zipfile.ZipFile(content) as archive:
                    stated = {stated_in(name, io.BytesIO(archive.read(name))) for name in archive.namelist()}
                    return True if True in stated else False if False in stated else None
    except _UNREADABLE:
        return None
    return None


def stated_by(entries: object) -> Stated:
    """Return what the entries of a JSON document state; None for other values."""
    stated = entries.get(KEY) if isinstance(entries, Mapping) else None
    return stated if isinstance(stated, bool) else None


def _word(text: object) -> Stated:
    """Return what `true`, `false`, or a comment such as `simulated=true` states."""
    word = text.decode("latin-1") if isinstance(text, bytes) else str(text)
    return {"true": True, "false": False}.get(word.removeprefix(f"{KEY}="))


def marked_pixels(pixels: Pixels, simulated: bool) -> Pixels:
    """Return a copy of the pixels with the band in the bottom left corner if `simulated`, else the same array."""
    return with_band(pixels, LETTERS, _LETTER_RATIO) if simulated else pixels


def without_band(light: Image) -> Image:
    """Return a copy of a marked picture, (rows, cols) or (rows, cols, 3), with its band replaced by 0."""
    rows, cols = _band(*light.shape[:2], LETTERS, _LETTER_RATIO).shape
    left = light.copy()
    left[-rows:, :cols] = 0
    return left


def with_band(pixels: Pixels, text: str, ratio: float, *, top_right: bool = False) -> Pixels:
    """Return a copy of the pixels with `text` in the bottom left corner, or in the opposite one.

    `ratio`: letter size over the picture's height.
    """
    band = _band(*pixels.shape[:2], text, ratio)
    rows, cols = band.shape
    marked = pixels.copy()
    corner = marked[:rows, -cols:] if top_right else marked[-rows:, :cols]
    corner[...] = band if pixels.ndim == 2 else band[..., np.newaxis]
    return marked


@lru_cache(maxsize=16)
def _band(rows: int, cols: int, text: str, ratio: float) -> Pixels:
    """Return a mark (text, white on black, grey pixels) for a picture of rows x cols, not larger than it."""
    size = max(_LETTER_MIN_PX, rows * ratio)
    size = max(1.0, size * min(1.0, cols / _lengths(text, size)[-1]))
    font = ImageFont.load_default(size)
    ends = _lengths(text, size)
    width = min(cols, round(ends[-1]))
    height = min(rows, round(1.25 * size))
    band = Pillow.new("L", (width, height), 0)
    for letter, end in zip(text, ends, strict=False):  # the last value is the right margin
        ImageDraw.Draw(band).text((end, height / 2), letter, fill=255, font=font, anchor="rm")
    return np.asarray(band)


def _lengths(text: str, size: float) -> list[float]:
    """Return the right end of each letter of a mark, and last the width of its band, pixels; `size`: letter size."""
    font = ImageFont.load_default(size)
    gap = 0.15 * size
    ends = list(accumulate((font.getlength(letter) + gap for letter in text), initial=0.3 * size))
    return [*ends[1:], ends[-1] + 0.45 * size]
