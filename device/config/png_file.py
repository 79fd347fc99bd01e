"""PNG files: what the chunks say about the pixels is applied here, or the file is refused with the chunk's name.

Portable Network Graphics Specification, third edition. Pillow decodes; it reads the chunks of orientation (eXIf) too.
"""

import struct
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL.PngImagePlugin import PngImageFile

from device.config.icc_profile import is_linear
from device.config.orientation import ORIENTATION, upright
from device.config.tiff_file import looked_up
from device.errors import FrameError

Pixels = NDArray[Any]
_GREY, _RGB, _PALETTE, _GREY_ALPHA, _RGB_ALPHA = 0, 2, 3, 4, 6  # colour types
_LINEAR = 100000  # gAMA of linear counts
_SPREAD = {2: 85, 4: 17}  # factors by which Pillow spreads grey of 2 and 4 bits to 8


def read_png(data: bytes, name: str) -> tuple[Pixels, str | None]:
    """Return the values of a PNG, (rows, cols) or (rows, cols, 3), upright, uint8 or uint16, and their encoding.

    The encoding is None, or the chunk that states values not linear in the light.
    An opaque alpha channel is dropped, a palette is looked up. FrameError for a property that is not applied;
    exceptions of Pillow for a damaged file.
    """
    chunks = _chunks(data)
    depth, colour = chunks["IHDR"][8:10]
    _refuse_chunks(chunks, depth, colour, name)
    with Pillow.open(BytesIO(data), formats=("PNG",)) as picture:
        assert isinstance(picture, PngImageFile)
        picture.load()
        orientation = int(picture.getexif().get(ORIENTATION, 1))
        profile = picture.info.get("icc_profile")
        pixels = np.asarray(picture)
    if depth == 16 and colour == _RGB:
        pixels = _decode_16_bit_colour(data)
    elif depth in _SPREAD and colour == _GREY:
        pixels = pixels // np.uint8(_SPREAD[depth])
    pixels = _without_alpha(chunks, pixels, colour, name)
    if colour == _PALETTE:
        table = np.frombuffer(chunks["PLTE"], np.uint8).reshape(-1, 3)
        pixels = looked_up(pixels, table * np.uint16(257))
    return upright(_unscaled(chunks, pixels, depth, colour), orientation, name), _encoding(chunks, profile)


def _chunks(data: bytes) -> dict[str, bytes]:
    """Return the chunks before the image data, and those after it, by their names; SyntaxError for no PNG."""
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise SyntaxError("its first bytes are those of no image format")
    chunks: dict[str, bytes] = {}
    place = 8
    while place + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, place)
        chunks.setdefault(kind.decode("latin-1"), data[place + 8 : place + 8 + size])
        place += 12 + size
    if len(chunks.get("IHDR", b"")) != 13:
        raise SyntaxError("it has no header")
    return chunks


def _refuse_chunks(chunks: dict[str, bytes], depth: int, colour: int, name: str) -> None:
    if depth == 1 and colour == _GREY:
        raise FrameError(f"{name} holds one bit for each pixel, which is no count", "Save the counts of the sensor.")
    if depth == 16 and colour in (_GREY_ALPHA, _RGB_ALPHA):  # the decoder would silently keep 8 bits per channel
        raise FrameError(
            f"{name} holds 16 bits with an alpha channel, which a png here cannot bring whole",
            "Save it as tiff or npy.",
        )
    if "acTL" in chunks:
        raise FrameError(f"{name} is an animation (acTL)", "Save the frame that is meant as a file of its own.")


def _encoding(chunks: dict[str, bytes], profile: bytes | None) -> str | None:
    """Return the chunk that states values not linear in the light; None if there is none."""
    gamma = struct.unpack(">I", chunks["gAMA"])[0] if "gAMA" in chunks else _LINEAR
    if "sRGB" in chunks:
        return "sRGB"
    if profile is not None and not is_linear(profile):
        return "iCCP"
    return None if gamma == _LINEAR else f"gAMA {gamma / _LINEAR:g}"


def _without_alpha(chunks: dict[str, bytes], pixels: Pixels, colour: int, name: str) -> Pixels:
    """Return pixels without an opaque alpha channel; FrameError for transparent pixels (alpha, tRNS)."""
    clear = False
    key = chunks.get("tRNS", b"")
    if colour in (_GREY_ALPHA, _RGB_ALPHA):
        clear = bool((pixels[..., -1] != 255).any())
        pixels = pixels[..., 0] if colour == _GREY_ALPHA else pixels[..., :3]
    elif colour == _PALETTE and key:
        opacity = np.full(256, 255, np.uint8)
        opacity[: len(key)] = np.frombuffer(key, np.uint8)
        clear = bool((opacity[pixels] != 255).any())
    elif key:
        same = pixels == (np.frombuffer(key, ">u2") if colour == _RGB else struct.unpack(">H", key)[0])
        clear = bool((same if same.ndim == 2 else same.all(axis=2)).any())
    if clear:
        raise FrameError(f"{name} has transparent pixels, which are no counts", "Save it without transparency.")
    return pixels


def _unscaled(chunks: dict[str, bytes], pixels: Pixels, depth: int, colour: int) -> Pixels:
    """Return the counts of a sensor with fewer bits (sBIT), if all pixels hold them with their first bits repeated."""
    bits = set(chunks.get("sBIT", b"")[: 1 if colour in (_GREY, _GREY_ALPHA) else 3])
    if colour == _PALETTE or len(bits) != 1 or not depth // 2 <= min(bits) < depth or depth < 8:
        return pixels
    spare = depth - min(bits)
    counts = pixels >> spare
    repeated = (counts << spare) | (counts >> (min(bits) - spare))
    return counts if bool((repeated == pixels).all()) else pixels


def _decode_16_bit_colour(data: bytes) -> Pixels:
    """Return the uint16 pixels of a 16-bit RGB PNG, (rows, cols, 3).

    Pillow has no such image: its mode RGB takes the first byte of each value. The second byte is the result of a second
    decoding with the byte order of the values exchanged.
    """
    halves = []
    for order in ("RGB;16B", "RGB;16L"):
        with Pillow.open(BytesIO(data)) as picture:
            assert isinstance(picture, PngImageFile)
            picture.tile = [tile._replace(args=order) for tile in picture.tile]
            picture.load()
            halves.append(np.asarray(picture).astype(np.uint16))
    return (halves[0] << np.uint16(8)) | halves[1]
