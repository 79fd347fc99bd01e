"""Image files: read TIFF, PNG, npy, npz and DNG; FrameError or PsfError for no valid image.

Layouts of an array, by the number of its axes; `frames_of` returns the frames of each:

    (rows, cols)                       one frame
    (rows, cols, 1) or (rows, cols, 3) one frame, grey or colour
    (n, rows, cols)                    n grey frames; n is at most the smaller side
    (n, rows, cols, 1 or 3)            n frames, grey or colour: the layout of LenslessPiCam

A raw is one frame; n PSFs are a stack (refraction or depth).
"""

import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from device.config.ceiling import CHANCE_PIXELS, ceiling_of
from device.config.dng_levels import NOT_STATED, Levels
from device.config.png_file import read_png
from device.config.tiff_file import read_tiff
from device.config.tiff_segments import MAX_COMPRESSION_RATIO, MAX_PIXELS
from device.errors import FrameError, PsfError
from device.values import Image, Mask, Psf

SUFFIXES = (".tif", ".tiff", ".png", ".npy")  # of the images of a recording's folder
MEASURE_PSF = "Give an image of one point of light in a dark room, neither saturated nor processed."
BORDER_PARTS = 4  # of each side of a PSF image
MIN_RISE = 0.005  # of its highest value, over the image: stray light that is taken out
MAX_UNEVEN = 0.15  # of the rise: rms of the border that a plane may leave
READABLE = (*SUFFIXES, ".npz", ".dng")
Pixels = NDArray[Any]
_DECODER_ERRORS = (  # exceptions of the decoders on truncated or damaged files
    ValueError,
    EOFError,
    OSError,
    SyntaxError,
    LookupError,
    TypeError,
    ArithmeticError,
    MemoryError,
    AssertionError,
    RuntimeError,
    UnidentifiedImageError,
    tifffile.TiffFileError,
    Pillow.DecompressionBombError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
    TokenError,
)


@dataclass(frozen=True)
class ImageFile:
    """Content of an image file: its frames, each (rows, cols) or (rows, cols, 3), in the stored type.

    `levels` are those that a DNG states, `encoding` the tag or chunk of values that are not linear in the light.
    """

    frames: tuple[Pixels, ...]
    levels: Levels = NOT_STATED
    encoding: str | None = None


def read_image(path: Path) -> Pixels:
    """Return the pixels of an image file, (rows, cols) or (rows, cols, 3), in the stored integer or float type.

    What the file says about its pixels is applied. FrameError for a property that is not applied, and for a file that
    is missing, empty, truncated, too large, not an image, or that holds several frames.
    """
    return only_frame(read_image_file(path).frames, str(path))


def read_counts(path: Path) -> Pixels:
    """Return the pixels of a raw frame or PSF; FrameError as for `read_image`, and for encoded values."""
    return only_frame(read_counts_file(path).frames, str(path))


def read_counts_file(path: Path) -> ImageFile:
    """Return all frames of a file of raw frames or PSFs; FrameError if it states values not linear in the light."""
    file = read_image_file(path)
    if file.encoding is not None:
        raise FrameError(
            f"{path} states that its values are not linear in the light ({file.encoding})",
            "Give the linear counts of the sensor. If these are, save them as npy, or as tiff without a profile.",
        )
    return file


def read_image_file(path: Path) -> ImageFile:
    """Return all frames of an image file, and the levels of a DNG; FrameError as for `read_image`.

    Of an npz with several arrays, `FILE.npz:NAME` selects one.
    """
    path, name = _named_array(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(
            f"{path} cannot be read: {error.strerror}", "Give the path of a readable image file."
        ) from error
    if not data:
        raise FrameError(f"{path} is empty", "Copy the file again; the copy was interrupted.")
    return _decoded(path, data, name)


def only_frame(frames: tuple[Pixels, ...], name: str) -> Pixels:
    """Return the frame of an image that has one; FrameError for a stack."""
    if len(frames) > 1:
        raise FrameError(
            f"{name} holds {len(frames)} frames of the shape {frames[0].shape}, and one frame is read",
            "Save the frame that is meant as a file of its own.",
        )
    return frames[0]


def frames_of(array: Pixels, name: str) -> tuple[Pixels, ...]:
    """Return the frames of an array in one of the layouts of this module; FrameError for another shape or type."""
    if array.dtype.kind not in "ufi" or array.size > 3 * MAX_PIXELS:
        raise FrameError(f"{name} holds {array.size} values of type {array.dtype}, which is no raw image")
    if array.ndim in (3, 4) and array.shape[-1] == 4:
        raise FrameError(
            f"{name} has a fourth channel (shape {array.shape}), and only three can be colours",
            "Save it without the fourth channel: (rows, cols) or (rows, cols, 3).",
        )
    match array.shape:
        case (rows, cols):
            shaped = array[None]
        case (rows, cols, 1):
            shaped = array[None, :, :, 0]
        case (rows, cols, 3):
            shaped = array[None]
        case (n, rows, cols, 1 | 3) if 1 <= n <= min(rows, cols):
            shaped = array[..., 0] if array.shape[3] == 1 else array
        case (n, rows, cols) if 1 <= n <= min(rows, cols) and cols > 4:
            shaped = array
        case _:
            rows = cols = 0
    if min(rows, cols) < 1:
        raise FrameError(
            f"{name}: an image has rows and columns, and three channels or none; this has the shape {array.shape}",
            "Save it as (rows, cols) or (rows, cols, 3); a stack of PSFs as (n, rows, cols).",
        )
    return tuple(np.ascontiguousarray(frame, frame.dtype.newbyteorder("=")) for frame in shaped)


def _named_array(path: Path) -> tuple[Path, str | None]:
    """Return the path and the array's name of `FILE.npz:NAME`; other paths are returned with None."""
    file, mark, name = str(path).rpartition(".npz:")
    return (Path(file + ".npz"), name) if mark else (path, None)


def _decoded(path: Path, data: bytes, name: str | None) -> ImageFile:
    """Return the content of a file, decoded by its suffix; FrameError if damaged, or for what is not applied."""
    suffix = path.suffix.lower()
    levels = NOT_STATED
    encoding = None
    if suffix not in READABLE:
        raise FrameError(
            f"{path}: the ending '{path.suffix}' is not one of {', '.join(READABLE)}",
            "Convert it without loss, for example to tiff or npy.",
        )
    try:
        match suffix:
            case ".npy":
                pixels = _loaded(BytesIO(data), str(path))
            case ".npz":
                pixels = _decode_npz(path, data, name)
            case ".png":
                pixels, encoding = read_png(data, str(path))
            case _:
                tiff = read_tiff(data, str(path), dng=suffix == ".dng")
                pixels = tiff.pixels
                levels = tiff.levels
                encoding = tiff.encoding
    except FrameError:
        raise
    except _DECODER_ERRORS as error:
        raise FrameError(
            f"{path} is not a whole {path.suffix[1:]} image: {_one_line(error)}",
            "Copy or export the file again; it is incomplete, or of another format than its ending.",
        ) from error
    return ImageFile(frames_of(pixels, str(path)), levels, encoding)


def _loaded(stream: IO[bytes], name: str) -> Pixels:
    """Return the array in the npy format of a stream; FrameError for Python objects, ValueError for another format."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
    _, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise FrameError(f"{name} holds Python objects (type {dtype}), no counts", "Save an array of numbers.")
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _one_line(error: BaseException) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "its first bytes are those of no image format"
    return " ".join(str(error).split()) or "too large"


def _decode_npz(path: Path, data: bytes, name: str | None) -> Pixels:
    """Return the only array of an npz, or the named one; FrameError lists the names, ValueError if it is too large."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        claimed_bytes = sum(member.file_size for member in archive.infolist())
    if claimed_bytes > MAX_COMPRESSION_RATIO * len(data) or claimed_bytes > 24 * MAX_PIXELS:
        raise ValueError(f"{len(data)} bytes cannot hold the {claimed_bytes} that it promises")
    with zipfile.ZipFile(BytesIO(data)) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        if name is None and len(members) == 1:
            name = next(iter(members))
        if name not in members:
            held = ", ".join(members) or "no array"
            first = next(iter(members), "NAME")
            raise FrameError(f"{path} holds {held}", f"Name the array that is meant, as in {path.name}:{first}.")
        return _loaded(BytesIO(archive.read(members[name])), f"{path}:{name}")


@dataclass(frozen=True)
class Raw:
    """Raw image for the solver: uint16 counts or float32, (rows, cols) or (rows, cols, 3).

    Pixels of at least `white_dn` are saturated: the ceiling of a clipped image, else the highest count of the converter
    (infinite for float). `bad` is the mask of invalid pixels, (rows, cols), `shift` the number of bits by which
    left-justified data were shifted right, `stored_bits` the bits of one stored value.
    """

    pixels: NDArray[np.uint16] | NDArray[np.float32]
    white_dn: float
    bad: Mask
    shift: int
    stored_bits: int


def as_raw(array: Pixels, name: str = "this image") -> Raw:
    """Return pixels of any integer or float type as `Raw`; FrameError for negative or more than 16-bit integers.

    12-bit data in 16-bit words are often left-justified by 4 bits. Then almost every count is a multiple of 16: counts
    are shifted right, and the few that are no multiple become bad pixels. NaN and infinite values become 0 and bad.
    """
    stored_bits = 8 * array.itemsize
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):
            values = array.astype(np.float32)
        invalid = ~np.isfinite(values)
        values[invalid] = 0
        bad = _any_channel(invalid)
        return Raw(*_ended(values, bad, float("inf")), bad, 0, stored_bits)
    if array.dtype.kind == "i" and array.size and array.min() < 0:
        raise FrameError(
            f"{name} holds negative whole numbers, which no sensor counts",
            "Save the counts as the camera gave them, or the difference of two frames as float.",
        )
    if array.max() > 65535:
        raise FrameError(f"{name} counts up to {array.max()}, more than 16 bits", "Give counts of at most 16 bits.")
    counts = array.astype(np.uint16)
    shift, stray = _justification(counts)
    counts = counts >> np.uint16(shift)
    bad = _any_channel(stray)
    top = int(counts[~bad].max()) if not bad.all() else 0
    bits = next(bits for bits in (8, 10, 12, 14, 16) if top < 2**bits)
    return Raw(*_ended(counts, bad, float(2**bits - 1)), bad, shift, stored_bits)


def _ended(pixels: Pixels, bad: Mask, highest_dn: float) -> tuple[Pixels, float]:
    """Return pixels, (rows, cols) or with channels, and their saturation level; `highest_dn` for those not clipped.

    Channels of a white balance end at different values: clipped pixels are then raised to one level for all channels.
    """
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    known = [np.where(bad, plane.min(), plane) for plane in np.moveaxis(planes, -1, 0)]
    ends = [ceiling_of(plane) for plane in known]
    found = [end for end in ends if end is not None]
    top = max(float(plane.max()) for plane in known)
    if not found:
        return pixels, highest_dn
    white_dn = max(found)
    if white_dn < top:  # of a channel that is not clipped
        white_dn = min(highest_dn, float(np.nextafter(np.float32(top), np.float32(np.inf))))
    if min(found) == white_dn:
        return pixels, white_dn
    raised = [
        plane if end is None else np.where(plane >= end, white_dn, plane)
        for plane, end in zip(known, ends, strict=True)
    ]
    return np.stack(raised, axis=-1).astype(pixels.dtype), white_dn


def common_white_dn(raws: Sequence[Raw]) -> float:
    """Return the saturation level of raws of one sensor: the lowest one that no pixel of any raw exceeds.

    The highest count of a converter follows from the brightest pixel of a file, and only clipped files show a ceiling.
    """
    top = max(float(raw.pixels.max()) for raw in raws)
    return min(raw.white_dn for raw in raws if raw.white_dn >= top)


def as_companion(array: Pixels, name: str) -> Image:
    """Return a dark or flat frame of any number type as float32, in its units.

    NaN where it is saturated (`as_raw`), if more than CHANCE_PIXELS are.
    """
    is_counts = array.dtype.kind in "ui" and array.min() >= 0 and array.max() <= 65535
    values = array.astype(np.float32)
    raw = as_raw(array if is_counts else values, name)
    full = raw.pixels >= raw.white_dn
    return np.where(full, np.float32(np.nan), values) if np.count_nonzero(full) > CHANCE_PIXELS else values


def with_levels(raw: Raw, levels: Levels) -> tuple[Raw, float | None]:
    """Return a raw with the white level of its file, and the black level of its file, both in the counts of the raw.

    A file states them for the stored values, which are shifted right by `raw.shift` bits.
    """
    scale = 2**raw.shift
    white_dn = raw.white_dn if levels.white_dn is None else min(raw.white_dn, float(levels.white_dn // scale))
    return replace(raw, white_dn=white_dn), None if levels.black_dn is None else levels.black_dn / scale


def _any_channel(mask: Mask) -> Mask:
    """Return the (rows, cols) mask of pixels with at least one channel set in `mask`, (rows, cols) or with channels."""
    return mask if mask.ndim == 2 else np.logical_or.reduce(mask, axis=2)


def _justification(counts: NDArray[np.uint16]) -> tuple[int, Mask]:
    """Return the left shift of the data in bits (8, 6, 4, 2 or 0), and the mask of values that do not fit it."""
    lit = int(np.count_nonzero(counts))  # zeros fit every justification and are no evidence
    for shift in (8, 6, 4, 2):
        stray = (counts & np.uint16(2**shift - 1)) != 0
        if stray.sum() <= 1e-4 * lit and (counts[~stray] >> shift).max(initial=0) > 255:
            return shift, stray
    return 0, np.zeros(counts.shape, np.bool_)


def as_psf(array: Pixels, name: str) -> Psf:
    """Return a measured PSF image as a Psf: justification undone, invalid pixels zeroed, pedestal subtracted, sum 1.

    A pedestal of mass beta makes every picture (1 + beta) times too bright away from its mean (NUMERICS.md 3.5, item
    6). Therefore the median of the border pixels is subtracted, and `background_plane`. Negative values stay: clipping
    would add mass again.
    The channels of a colour PSF are averaged. PsfError for NaN, infinite values, negative integers, an image of one
    value (dark or saturated all over), or a sum <= 0.
    """
    return _cleaned(psf_counts(array, name), name)


def clean_channels(raw: Raw, name: str) -> tuple[Psf, ...]:
    """Return the PSF of each channel of `psf_counts`, cleaned as by `as_psf`; one PSF for a grey PSF.

    Three equal channels are a grey PSF.
    """
    pixels = raw.pixels
    if pixels.ndim == 2:
        return (_cleaned(raw, name),)
    if np.array_equal(pixels[..., 0], pixels[..., 1]) and np.array_equal(pixels[..., 0], pixels[..., 2]):
        return (_cleaned(replace(raw, pixels=pixels[..., 0]), name),)
    return tuple(_cleaned(replace(raw, pixels=pixels[..., c]), name) for c in range(3))


def psf_counts(array: Pixels, name: str) -> Raw:
    """Return the pixels of a PSF image as `Raw`; PsfError if they are not numbers, or negative counts."""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise PsfError(f"{name} holds values that are not numbers (NaN or infinite)", MEASURE_PSF)
    try:
        return as_raw(array, name)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error


def saturated_share(psf: Psf, raw: Raw, white_dn: float | None = None) -> float:
    """Return the share of the PSF's light in more than CHANCE_PIXELS saturated pixels; else 0.0.

    `raw` holds the counts of the PSF, `white_dn` its saturation level if that is known.
    """
    brightest = raw.pixels if raw.pixels.ndim == 2 else raw.pixels.max(axis=2)
    full = brightest >= min(raw.white_dn, float("inf") if white_dn is None else white_dn)
    return float(psf.pixels[full].sum(dtype=np.float64)) if np.count_nonzero(full) > CHANCE_PIXELS else 0.0


def background_plane(pixels: Pixels, good: Mask) -> NDArray[np.float64] | None:
    """Return the plane of stray light that rises over a PSF image, (rows, cols) in its units; None without one.

    It is the least-squares plane through the medians of parts of the border, if it explains them and rises by more than
    MIN_RISE of the highest value.
    """
    size = np.array(pixels.shape)
    edge = max(1, min(pixels.shape) // 50)
    places, medians = [], []
    for part in _border_parts(pixels.shape, edge):
        if good[part].any():
            middle = np.array([(span.start + span.stop - 1) / 2 for span in part])
            places.append([1.0, *(middle / (size - 1) - 0.5)])
            medians.append(float(np.median(pixels[part][good[part]])))
    if len(medians) < 4 * BORDER_PARTS or min(pixels.shape) <= 8:
        return None
    plane = np.linalg.lstsq(np.array(places), np.array(medians), rcond=None)[0]
    left = np.array(medians) - np.array(places) @ plane
    rise = float(np.abs(plane[1:]).sum())
    if rise < MIN_RISE * float(pixels.max() - np.median(medians)) or float(left.std()) > MAX_UNEVEN * rise:
        return None
    rows, cols = (np.linspace(-0.5, 0.5, count) for count in pixels.shape)
    return np.asarray(plane[0] + plane[1] * rows[:, None] + plane[2] * cols, np.float64)


def _border_parts(shape: tuple[int, ...], edge: int) -> list[tuple[slice, slice]]:
    """Return BORDER_PARTS equal parts of each side of an image's border, `edge` pixels wide."""
    rows, cols = (np.linspace(0, size, BORDER_PARTS + 1).astype(int) for size in shape)
    across = [slice(*pair) for pair in pairwise(cols)]
    down = [slice(*pair) for pair in pairwise(rows)]
    ends = [(slice(0, edge), slice(size - edge, size)) for size in shape]
    return [(end, part) for end in ends[0] for part in across] + [(part, end) for end in ends[1] for part in down]


def _cleaned(raw: Raw, name: str) -> Psf:
    """Return the PSF of counts, averaged over the channels, without pedestal and invalid pixels; see `as_psf`."""
    top = raw.pixels.max()
    if top > 0 and raw.pixels.min() == top:
        what = "saturated" if top >= raw.white_dn else "even"
        raise PsfError(f"{name} is {what}: every pixel has the value {top:g}", MEASURE_PSF)
    pixels = raw.pixels.astype(np.float32)
    if pixels.ndim == 3:
        pixels = pixels.mean(axis=2)
    good = ~raw.bad
    plane = background_plane(pixels, good)
    if plane is not None:
        pixels = np.asarray(pixels - plane, np.float32)
    edge = max(1, min(pixels.shape) // 50)
    border = np.ones(pixels.shape, np.bool_)
    border[edge:-edge, edge:-edge] = False
    pedestal = float(np.median(pixels[border & good])) if (border & good).any() and min(pixels.shape) > 8 else 0.0
    pixels = np.where(good, pixels - np.float32(pedestal), np.float32(0))
    try:
        return Psf(pixels, name)
    except PsfError as error:
        raise PsfError(error.message, MEASURE_PSF) from error


def require_same_shape(psfs: tuple[Psf, ...], shape: tuple[int, int]) -> None:
    """Raise PsfError for PSFs of another shape than the raw: another camera mode has another scale."""
    for psf in psfs:
        require_raw_shape(psf.name, psf.shape, shape)


def require_raw_shape(name: str, psf: tuple[int, int], raw: tuple[int, int]) -> None:
    """Raise PsfError if a PSF, `name`, has other rows or columns than the raw."""
    if psf != raw:
        raise PsfError(
            f"{name} has {psf[0]} x {psf[1]} pixels, the raw {raw[0]} x {raw[1]}",
            "Turn the PSF by a quarter, as the raw is stored."
            if psf == raw[::-1]
            else "Give the PSF that was measured in the same camera mode as the raw.",
        )


def read_psf(path: Path) -> Psf:
    """Return the PSF in an image file, cleaned by `as_psf`; PsfError for a file that is no image or no PSF."""
    try:
        array = read_counts(path)
    except FrameError as error:
        raise PsfError(error.message, error.remedy) from error
    return as_psf(array, path.name)
