"""TIFF and DNG files: what their tags say about the pixels is applied here, or the file is refused with the tag's name.

TIFF 6.0; TIFF Technical Notes; DNG 1.7 for the tags of `device/config/dng_levels.py`.
"""

from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from device.config.dng_levels import NOT_STATED, Levels, tag_values, with_dng_levels
from device.config.icc_profile import is_linear
from device.config.orientation import upright
from device.config.tiff_segments import stored_values
from device.errors import FrameError

Pixels = NDArray[Any]
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE = 0, 1, 2, 3
_RAW = (tifffile.PHOTOMETRIC.CFA, tifffile.PHOTOMETRIC.LINEAR_RAW)
_MASK = 4  # bit of NewSubfileType
_WHOLE_PAGE = (0, 2)  # NewSubfileType: a full-resolution image, or one page of several
_ALPHA = (1, 2)  # ExtraSamples: associated and unassociated alpha; 0 is unspecified
# Tags that change the meaning of values or their places, with the value that changes nothing (None: there is none).
_NOT_APPLIED: dict[int, tuple[str, tuple[float, ...] | None]] = {
    291: ("GrayResponseCurve", None),
    301: ("TransferFunction", None),
    433: ("Decode", None),
    346: ("Indexed", (0,)),
    532: ("ReferenceBlackWhite", (0, 255, 0, 255, 0, 255)),
    32997: ("ImageDepth", (1,)),
    50711: ("CFALayout", (1,)),
    50718: ("DefaultScale", (1, 1)),
    50974: ("SubTileBlockSize", (1, 1)),
    50975: ("RowInterleaveFactor", (1,)),
    52547: ("ColumnInterleaveFactor", (1,)),
    51125: ("DefaultUserCrop", (0, 0, 1, 1)),
}
_OPERATIONS = {51008: "OpcodeList1", 51009: "OpcodeList2", 51022: "OpcodeList3"}
_MISSING_VALUE = 42113  # GDAL_NODATA
_PROFILE = 34675  # InterColorProfile


@dataclass(frozen=True)
class TiffContent:
    """Pixels of a TIFF in one of the layouts of image_files.py, upright.

    `levels` are stated by a DNG, `encoding` is the tag that states values not linear in the light.
    """

    pixels: Pixels
    levels: Levels = NOT_STATED
    encoding: str | None = None


def read_tiff(data: bytes, name: str, dng: bool = False) -> TiffContent:
    """Return the full-resolution image of a TIFF, or its pages as a stack; `dng`: one without a raw image is refused.

    FrameError for a property that is not applied, and for several images of which none is meant; ValueError and other
    exceptions of tifffile for a damaged file.
    """
    with tifffile.TiffFile(BytesIO(data)) as tiff:
        pages = _meant_pages(tiff, name, dng)
        _refuse_frames_beyond_pages(tiff, len(pages), name)
        first = tiff.pages.first
        contents = [_content(page, first, name) for page in pages]
    if len({content.levels for content in contents}) > 1:
        raise FrameError(f"{name} holds raw images of different levels or patterns", "Save each as a file of its own.")
    if len(contents) == 1:
        return contents[0]
    return TiffContent(np.stack([content.pixels for content in contents]), contents[0].levels, contents[0].encoding)


def _meant_pages(tiff: tifffile.TiffFile, name: str, dng: bool) -> list[tifffile.TiffPage]:
    """Return the pages of full resolution, all of one shape; of a file with raw images only these."""
    top = [page.aspage() for page in tiff.pages]
    pages = [inner.aspage() for page in top for inner in (page, *(page.pages or ()))]
    if any(page.subfiletype & _MASK or page.photometric == tifffile.PHOTOMETRIC.MASK for page in pages):
        raise FrameError(f"{name} holds a transparency mask beside the image", "Save it without transparency.")
    raws = [page for page in pages if page.photometric in _RAW]
    if dng and not raws:
        raise FrameError(f"{name} holds no raw image", "Give the DNG as the camera wrote it, or a tiff or npy.")
    pages = raws or pages
    meant = [page for page in pages if page.subfiletype in _WHOLE_PAGE]
    if not meant:
        raise FrameError(
            f"{name} holds only a copy of reduced resolution (NewSubfileType {pages[0].subfiletype})",
            "Give the file with the image of full resolution.",
        )
    shapes = {
        f"{page.imagelength} x {page.imagewidth} x {page.samplesperpixel}, {page.bitspersample} bits" for page in meant
    }
    if len(shapes) > 1:
        raise FrameError(
            f"{name} holds {len(meant)} images of different sizes or types ({'; '.join(sorted(shapes))}), and none is "
            "marked as a reduced copy",
            "Save the image that is meant as a file of its own.",
        )
    return meant


def _refuse_frames_beyond_pages(tiff: tifffile.TiffFile, pages: int, name: str) -> None:
    """Raise FrameError for frames that follow the only page without one of their own (ImageJ, tifffile's truncate)."""
    hidden = int((tiff.imagej_metadata or {}).get("images", 1))
    if any(shaped.get("truncated") for shaped in tiff.shaped_metadata or ()):
        hidden = max(hidden, 2)
    if pages == 1 and hidden > 1:
        raise FrameError(
            f"{name} holds several frames in one page, which only the program that wrote it knows",
            "Save them as pages, or as npy.",
        )


def _content(page: tifffile.TiffPage, first: tifffile.TiffPage, name: str) -> TiffContent:
    """Return the pixels of a page as its tags say; a DNG states the orientation in its first page."""
    _refuse_tags(page, name)
    kind = _meaning(page, name)
    values = _without_alpha(page, kind, stored_values(page, name), name)
    _refuse_missing(page, values, name)
    pixels = _interpreted(page, kind, values, name)
    turned = page.tags.get("Orientation") or first.tags.get("Orientation")
    orientation = 1 if turned is None else int(turned.value)
    if page.photometric in _RAW:
        return TiffContent(*with_dng_levels(page, pixels, orientation, name))
    profile = page.tags.get(_PROFILE)
    encoded = profile is not None and not is_linear(bytes(profile.value))
    return TiffContent(upright(pixels, orientation, name), encoding="ICC profile" if encoded else None)


def _refuse_tags(page: tifffile.TiffPage, name: str) -> None:
    for code, (word, neutral) in _NOT_APPLIED.items():
        tag = page.tags.get(code)
        if tag is not None and (neutral is None or tag_values(tag) != neutral):
            raise FrameError(
                f"{name} has the tag {word} ({code}), which is not applied here",
                "Save the linear counts without it, as tiff or npy.",
            )
    for code, word in _OPERATIONS.items():
        tag = page.tags.get(code)
        if tag is not None and any(tag_values(tag)[:4]):
            raise FrameError(
                f"{name} asks for corrections of its pixels ({word}), which are not applied here",
                "Convert it to a DNG, tiff or npy with these corrections or without them.",
            )


def _refuse_missing(page: tifffile.TiffPage, values: Pixels, name: str) -> None:
    """Raise FrameError if some values are the number that stands for a missing pixel."""
    tag = page.tags.get(_MISSING_VALUE)
    if tag is not None and bool((values == np.float64(str(tag.value).strip("\0 "))).any()):
        raise FrameError(
            f"{name} has missing pixels, which hold the value {tag.value} (GDAL_NODATA)",
            "Save it without missing pixels, or as float npy with NaN in their places.",
        )


def _without_alpha(page: tifffile.TiffPage, kind: int, values: Pixels, name: str) -> Pixels:
    """Return values without an opaque alpha channel; FrameError for transparent pixels and for unspecified channels.

    Three channels of which none is alpha stay, whether they are stated as colours or not.
    """
    if values.ndim == 2 or kind == tifffile.PHOTOMETRIC.LINEAR_RAW:
        return values
    colours = 3 if kind == _RGB else 1
    extras = (*(int(extra) for extra in page.extrasamples), *(0,) * values.shape[2])[: values.shape[2] - colours]
    if values.shape[2] < colours or (any(extra not in _ALPHA for extra in extras) and values.shape[2] != 3):
        raise FrameError(
            f"{name} has {values.shape[2]} channels (SamplesPerPixel), of which its tags describe {colours}",
            "Save it with one channel or three.",
        )
    opaque = 1 if values.dtype.kind == "f" else 2 ** int(page.bitspersample) - 1
    for place, extra in enumerate(extras, colours):
        if extra in _ALPHA and bool((values[..., place] != opaque).any()):
            raise FrameError(
                f"{name} has transparent pixels (alpha channel), which are no counts",
                "Save it without transparency.",
            )
    kept = [*range(colours), *(place for place, extra in enumerate(extras, colours) if extra not in _ALPHA)]
    return values[..., 0] if len(kept) == 1 else values[..., kept]


def _meaning(page: tifffile.TiffPage, name: str) -> int:
    """Return the PhotometricInterpretation of a page, grey if not stated; FrameError for one that is not read."""
    tag = page.tags.get("PhotometricInterpretation")
    kind = _BLACK_IS_ZERO if tag is None else int(tag.value)
    signed = page.sampleformat not in (1, 4)
    if kind in (_BLACK_IS_ZERO, _RGB, *_RAW) or (kind in (_WHITE_IS_ZERO, _PALETTE) and not signed):
        return kind
    try:
        word = tifffile.PHOTOMETRIC(kind).name
    except ValueError:
        word = "unknown"
    raise FrameError(
        f"{name} has values of SampleFormat {page.sampleformat} that mean {word} (PhotometricInterpretation {kind})",
        "Save it as grey (min-is-black) or as red, green and blue.",
    )


def _interpreted(page: tifffile.TiffPage, kind: int, values: Pixels, name: str) -> Pixels:
    """Return counts of which more is brighter: min-is-white inverted, a palette looked up."""
    if kind == _WHITE_IS_ZERO:
        return np.asarray(values.dtype.type(2 ** int(page.bitspersample) - 1) - values)
    if kind == _PALETTE:
        if page.colormap is None or values.ndim > 2:
            raise FrameError(f"{name} has no whole palette (PhotometricInterpretation 3)", "Save it as grey.")
        return looked_up(values, np.asarray(page.colormap).T)
    return values


def looked_up(indices: Pixels, table: NDArray[np.uint16]) -> Pixels:
    """Return the colours of a (n, 3) palette: (rows, cols) if all that are used are grey, else (rows, cols, 3).

    They are uint8 if every entry that is used holds 8 bits (times 257, or times 256), else uint16. ValueError for an
    index beyond n.
    """
    used = np.unique(indices)
    if used[-1] >= len(table):
        raise ValueError(f"the index {used[-1]} lies beyond the palette of {len(table)} colours")
    entries = table[used]
    low = entries & np.uint16(255)
    high = entries >> np.uint16(8)
    if (low == high).all() or not low.any():
        table = (table >> np.uint16(8)).astype(np.uint8)
    grey = bool((entries == entries[:, :1]).all())
    return table[indices, 0] if grey else table[indices]
