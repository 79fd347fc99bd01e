"""Random image files with the properties that other programs write, and the pixels that a reader must find in them.

python -m tests.property.encoded_images [N]     read N files (500 by default) and print what became of each property

The writers of TIFF, DNG and PNG share no code with the reader; Pillow compresses. A property is read, or refused with
the word of REFUSED.
"""

import struct
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow

from device.config.image_files import read_counts_file
from device.errors import FrameError

Pixels = NDArray[Any]
Tags = dict[int, tuple[str, tuple[float, ...]]]
TYPES = {"B": 1, "s": 2, "H": 3, "I": 4, "2I": 5}  # codes of the types of a tag; 2I is a fraction
KINDS = ("u2", "u4", "u8", "u10", "u12", "u14", "u16", "u32", "i16", "i32", "f16", "f32", "f64")


@dataclass
class Encoded:
    """A file's bytes and suffix, the pixels that it means, and its properties by name.

    `refused`: the word that a refusal must hold; None for a file that is read. `levels`: pattern, black and white
    level of a DNG.
    """

    suffix: str
    data: bytes
    meant: Pixels
    names: list[str]
    refused: str | None = None
    levels: tuple[str | None, float | None, float | None] = (None, None, None)


def counts(rng: np.random.Generator, kind: str, colour: bool = False) -> Pixels:
    """Return smooth counts with noise of a type such as u12, between 33 and 90 rows and columns."""
    rows, cols = rng.integers(33, 90, 2)
    y, x = np.mgrid[:rows, :cols]
    scene = 0.5 + 0.3 * np.sin(x / 9 + y / 17) + 0.1 * rng.random((rows, cols))
    if colour:
        scene = np.stack([scene, 0.7 * scene, 0.4 * scene], axis=2)
    letter, bits = kind[0], int(kind[1:])
    if letter == "f":
        return scene.astype(f"f{bits // 8}")
    top = 2 ** min(bits, 12) - 1
    return np.rint(scene * top).astype(f"{letter}{max(8, 2 ** int(np.ceil(np.log2(bits)))) // 8}")


# TIFF


@dataclass
class TiffWriter:
    """Coding of one page: order "<" or ">", bits, compression, predictor, bit order, tiles or strips, planes."""

    order: str = "<"
    bits: int = 16
    kind: str = "u"
    compression: int = 1
    predictor: int = 1
    fill_order: int = 1
    tile: tuple[int, int] | None = None
    strip: int = 7
    planar: bool = False

    def segments(self, image: Pixels) -> tuple[list[bytes], Tags]:
        """Return strips or tiles of (rows, cols, samples), and the tags that describe them."""
        rows, cols, samples = image.shape
        planes = [image[..., c : c + 1] for c in range(samples)] if self.planar else [image]
        height, width = self.tile or (self.strip, cols)
        parts = []
        for plane in planes:
            for top in range(0, rows, height):
                for left in range(0, cols, width):
                    part = plane[top : top + height, left : left + width]
                    if self.tile:
                        part = np.pad(part, ((0, height - part.shape[0]), (0, width - part.shape[1]), (0, 0)))
                    parts.append(self.packed(part))
        tags: Tags = {
            256: ("I", (cols,)),
            257: ("I", (rows,)),
            258: ("H", (self.bits,) * samples),
            259: ("H", (self.compression,)),
            277: ("H", (samples,)),
            284: ("H", (2 if self.planar else 1,)),
        }
        tags |= {322: ("I", (width,)), 323: ("I", (height,))} if self.tile else {278: ("I", (height,))}
        if self.kind != "u":
            tags[339] = ("H", ({"i": 2, "f": 3, "c": 6}[self.kind],) * samples)
        tags |= {317: ("H", (self.predictor,))} if self.predictor != 1 else {}
        tags |= {266: ("H", (self.fill_order,))} if self.fill_order != 1 else {}
        return parts, tags

    def packed(self, part: Pixels) -> bytes:
        """Return the bytes of a strip or tile."""
        rows, cols, samples = part.shape
        if self.predictor == 2:
            whole = part.view(f"u{part.itemsize}")
            part = np.diff(whole, axis=1, prepend=np.zeros_like(whole[:, :1]))
        if self.predictor == 3:
            ordered = np.ascontiguousarray(part).astype(part.dtype.newbyteorder(">")).view(np.uint8)
            lines = ordered.reshape(rows, cols * samples, -1).transpose(0, 2, 1).reshape(rows, -1, samples)
            lines = np.diff(lines, axis=1, prepend=np.zeros_like(lines[:, :1])).reshape(rows, -1)
        elif self.bits % 8:
            bits = (part[..., None] >> np.arange(self.bits - 1, -1, -1)) & 1
            lines = np.packbits(bits.reshape(rows, -1).astype(np.uint8), axis=1)
        else:
            lines = (
                np.ascontiguousarray(part).astype(part.dtype.newbyteorder(self.order)).view(np.uint8).reshape(rows, -1)
            )
        if self.fill_order == 2:
            lines = np.packbits(np.unpackbits(lines, axis=1), axis=1, bitorder="little")
        return compressed(np.ascontiguousarray(lines), self.compression)


def compressed(lines: NDArray[np.uint8], code: int) -> bytes:
    """Return rows of bytes compressed by zlib, or by libtiff as the strip of a grey image."""
    names = {5: "tiff_lzw", 32773: "packbits", 34925: "lzma", 50000: "zstd"}
    if code in (8, 32946):
        return zlib.compress(lines.tobytes())
    if code not in names:
        return lines.tobytes()
    out = BytesIO()
    Pillow.fromarray(lines).save(out, "tiff", compression=names[code], strip_size=2**30)
    with tifffile.TiffFile(BytesIO(out.getvalue())) as tiff:
        page = tiff.pages.first
        return out.getvalue()[page.dataoffsets[0] :][: page.databytecounts[0]]


def tiff_bytes(pages: list[tuple[list[bytes], Tags]], order: str, big: bool) -> bytes:
    """Return a TIFF or BigTIFF of pages, each its segments and tags."""
    offset, size, count = ("Q", 8, "Q") if big else ("I", 4, "H")
    head = b"II" if order == "<" else b"MM"
    header = struct.pack(order + "2sHHHQ", head, 43, 8, 0, 16) if big else struct.pack(order + "2sHI", head, 42, 8)
    out, link = bytearray(header), len(header) - size
    for parts, given in pages:
        tags = dict(given)
        places = []
        for part in parts:
            places.append(len(out))
            out += part
        tiled = 322 in tags
        tags[324 if tiled else 273] = ("I", tuple(places))
        tags[325 if tiled else 279] = ("I", tuple(len(part) for part in parts))
        entries = []
        for tag, (kind, values) in sorted(tags.items()):
            body = struct.pack(f"{order}{len(values)}{kind[-1].replace('s', 'B')}", *values)
            number = len(values) // (2 if kind[0] == "2" else 1)
            if len(body) > size:
                out += bytes(len(out) % 2)
                place, body = struct.pack(order + offset, len(out)), (out.extend(body), b"")[1]
                entries.append((tag, TYPES[kind], number, place))
            else:
                entries.append((tag, TYPES[kind], number, body.ljust(size, b"\0")))
        out += bytes(len(out) % 2)
        struct.pack_into(order + offset, out, link, len(out))
        out += struct.pack(order + count, len(entries))
        for tag, code, number, body in entries:
            out += struct.pack(f"{order}HH{offset}", tag, code, number) + body
        link = len(out)
        out += bytes(size)
    return bytes(out)


def stored(upright: Pixels, orientation: int) -> Pixels:
    """Return the pixels that a file with this orientation stores of an upright image."""
    # the transposition of Pillow that shows the image upright is undone by its inverse
    inverse: dict[int, Callable[[Pixels], Pixels]] = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a, 1),
        7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
        8: lambda a: np.rot90(a, -1),
    }
    return np.ascontiguousarray(inverse[orientation](upright))


@dataclass
class Draft:
    """A TIFF before it is written: the image that it means, its coding, tags and further pages."""

    rng: np.random.Generator
    meant: Pixels
    writer: TiffWriter
    names: list[str]
    stored: Pixels = field(init=False)  # (rows, cols, samples)
    tags: Tags = field(default_factory=dict)
    before: list[tuple[Pixels, Tags]] = field(default_factory=list)
    after: list[tuple[Pixels, Tags]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stored = self.meant if self.meant.ndim == 3 else self.meant[..., None]
        self.tags[262] = ("H", (2 if self.meant.ndim == 3 else 1,))

    @property
    def top(self) -> int:
        """Largest count of the stored bits."""
        return int(2**self.writer.bits - 1)

    @property
    def is_grey(self) -> bool:
        """Whether the image is one channel of unsigned counts of at most 16 bits."""
        return self.stored.shape[2] == 1 and self.writer.kind == "u" and self.writer.bits <= 16

    def written(self) -> bytes:
        """Return the file."""
        pages = [*self.before, (self.stored, {}), *self.after]
        encoded = []
        for image, tags in pages:
            parts, described = self.writer.segments(image)
            encoded.append((parts, described | self.tags | tags))
        return tiff_bytes(encoded, self.writer.order, big=bool(self.rng.random() < 0.2))


def turned(draft: Draft) -> None:
    orientation = int(draft.rng.integers(1, 9))
    draft.stored, draft.tags[274] = stored(draft.stored, orientation), ("H", (orientation,))
    draft.names.append(f"orientation {orientation}")


def white_is_zero(draft: Draft) -> None:
    if draft.is_grey and draft.tags[262] == ("H", (1,)):
        draft.stored, draft.tags[262] = (draft.top - draft.stored).astype(draft.stored.dtype), ("H", (0,))
        draft.names.append("min-is-white")


def palette(draft: Draft) -> None:
    if draft.is_grey and draft.writer.bits in (4, 8) and draft.tags[262] == ("H", (1,)):
        order = draft.rng.permutation(draft.top + 1)
        table = np.zeros((3, draft.top + 1), int)
        table[:, order] = np.arange(draft.top + 1) * 257
        draft.stored, draft.tags[262] = order[draft.stored].astype(draft.stored.dtype), ("H", (3,))
        draft.tags[320] = ("H", tuple(table.ravel()))
        draft.names.append("palette")


def opaque(draft: Draft) -> None:
    if draft.writer.kind == "u" and draft.writer.bits in (8, 16):
        draft.stored = np.pad(draft.stored, ((0, 0), (0, 0), (0, 1)), constant_values=draft.top)
        draft.tags[338] = ("H", (int(draft.rng.integers(1, 3)),))
        draft.names.append("opaque alpha")


def preview(draft: Draft) -> None:
    where = draft.before if draft.rng.random() < 0.5 else draft.after
    where.append((draft.stored[::4, ::4], {254: ("I", (1,))}))
    draft.names.append("preview first" if where is draft.before else "preview last")


def coded(draft: Draft) -> None:
    rng, writer = draft.rng, draft.writer
    writer.compression = int(rng.choice([1, 1, 5, 8, 32946, 32773, 34925, 50000]))
    writer.tile = (16 * int(rng.integers(1, 4)), 16 * int(rng.integers(1, 4))) if rng.random() < 0.4 else None
    writer.planar = draft.stored.shape[2] > 1 and bool(rng.random() < 0.5)
    if writer.compression not in (1, 32773) and writer.bits % 8 == 0 and rng.random() < 0.5:
        writer.predictor = int(rng.choice([2, 3])) if writer.kind == "f" else 2
    if writer.compression == 1 and rng.random() < 0.3:
        writer.fill_order = 2
    layout = f"{'tiles' if writer.tile else 'strips'}{', planes' if writer.planar else ''}"
    draft.names += [f"compression {writer.compression}", f"predictor {writer.predictor}", layout]
    draft.names += ["reversed bits"] * (writer.fill_order == 2)


READ: tuple[Callable[[Draft], None], ...] = (turned, white_is_zero, palette, opaque, preview)


def plain(rng: np.random.Generator, kind: str, colour: bool = False) -> Draft:
    """Return a TIFF of counts of a type, without further properties."""
    order, strip = str(rng.choice(["<", ">"])), int(rng.integers(1, 100))
    letter, bits = kind[0], int(kind[1:])
    return Draft(rng, counts(rng, kind, colour), TiffWriter(order, bits, letter, strip=strip), [kind])


def random_tiff(rng: np.random.Generator) -> Encoded:
    """Return a TIFF of any type of counts with some of the properties that are read."""
    draft = plain(rng, str(rng.choice(KINDS)), bool(rng.random() < 0.25))
    for apply in READ:
        if rng.random() < 0.5:
            apply(draft)
    coded(draft)
    return Encoded(str(rng.choice([".tif", ".tiff"])), draft.written(), draft.meant, draft.names)


def tagged(code: int, kind: str, *values: float) -> Callable[[Draft], None]:
    return lambda draft: draft.tags.update({code: (kind, values)})


def channel(meaning: int) -> Callable[[Draft], None]:
    """Return the property of a last channel that is not even; `meaning`: 2 for alpha, 0 for unspecified."""

    def apply(draft: Draft) -> None:
        draft.stored = np.concatenate([draft.stored, draft.stored[..., :1]], axis=2)
        draft.tags[338] = ("H", (meaning,))

    return apply


def typed(kind: str, bits: int, dtype: type[np.generic]) -> Callable[[Draft], None]:
    def apply(draft: Draft) -> None:
        draft.writer.kind, draft.writer.bits, draft.stored = kind, bits, draft.stored.astype(dtype)

    return apply


def signed_white_is_zero(draft: Draft) -> None:
    draft.writer.kind, draft.tags[262] = "i", ("H", (0,))


def second_page(**tags: float) -> Callable[[Draft], None]:
    return lambda draft: draft.after.append((draft.stored[:20], {254: ("I", (tags.get("kind", 0),))}))


def inks(draft: Draft) -> None:
    draft.stored, draft.tags[262] = np.concatenate([draft.stored] * 4, axis=2), ("H", (5,))


def without_codec(draft: Draft) -> None:
    draft.writer.predictor = 2


REFUSED: dict[str, tuple[str, Callable[[Draft], None]]] = {
    "jpeg": ("JPEG (TIFF compression 7), which changes the counts", tagged(259, "H", 7)),
    "old jpeg": ("OJPEG (TIFF compression 6), which changes the counts", tagged(259, "H", 6)),
    "fax": ("compressed by CCITTFAX4", tagged(259, "H", 4)),
    "webp": ("compressed by WEBP", tagged(259, "H", 50001)),
    "jpeg 2000": ("compressed by", tagged(259, "H", 34712)),
    "unknown codec": ("compression 60000", tagged(259, "H", 60000)),
    "transparent": ("transparent", channel(2)),
    "unspecified channel": ("SamplesPerPixel", channel(0)),
    "complex": ("complex", typed("c", 64, np.complex64)),
    "24 bits": ("24 bits", tagged(258, "H", 24)),
    "one bit": ("one bit", tagged(258, "H", 1)),
    "signed min-is-white": ("MINISWHITE", signed_white_is_zero),
    "transfer function": ("TransferFunction", tagged(301, "H", *range(256))),
    "grey response": ("GrayResponseCurve", tagged(291, "H", *range(256))),
    "cmyk": ("SEPARATED", inks),
    "lab": ("CIELAB", tagged(262, "H", 8)),
    "ycbcr": ("YCBCR", tagged(262, "H", 6)),
    "orientation 9": ("orientation 9", tagged(274, "H", 9)),
    "depth": ("ImageDepth", tagged(32997, "I", 3)),
    "missing value": ("GDAL_NODATA", tagged(42113, "s", *b"20\0")),
    "only a preview": ("reduced resolution", tagged(254, "I", 1)),
    "mask": ("transparency mask", second_page(kind=4)),
    "two sizes": ("different sizes", second_page()),
    "predictor alone": ("predictor 2", without_codec),
}


def refused_tiff(rng: np.random.Generator) -> Encoded:
    """Return a TIFF with one property that is not applied."""
    name = str(rng.choice(list(REFUSED)))
    draft = plain(rng, "u8")
    draft.stored[0, 0] = draft.meant[0, 0] = 20
    word, apply = REFUSED[name]
    apply(draft)
    return Encoded(".tiff", draft.written(), draft.meant, [name], word)


# DNG


def random_dng(rng: np.random.Generator) -> Encoded:
    """Return a DNG: levels, areas, table and orientation are applied, the counts may be left-justified."""
    draft = plain(rng, str(rng.choice(["u10", "u12", "u14", "u16"])))
    if draft.writer.bits == 16 and rng.random() < 0.5:
        draft.meant = draft.meant << np.uint16(4)
        draft.names.append("left-justified")
    black, white = int(rng.integers(0, 300)), int(draft.meant.max()) + int(rng.integers(1, 50))
    draft.stored = draft.meant[..., None]
    draft.tags |= {
        262: ("H", (34892,)),
        50706: ("B", (1, 4, 0, 0)),
        50714: ("2I", (2 * black, 2)),
        50717: ("I", (white,)),
    }
    for apply in (turned, cropped, with_margins, black_of_sites, tabled):
        if rng.random() < 0.5:
            apply(draft)
    coded(draft)
    lowest = float(min(draft.tags[50714][1])) if 50713 in draft.tags else float(black)
    levels = (None, lowest, float(draft.tags[50717][1][0]))
    return Encoded(".dng", draft.written(), draft.meant, draft.names, None, levels)


def padded(draft: Draft) -> tuple[int, int]:
    """Add noise around the stored image; return the rows above it and the columns left of it."""
    top, left, below, right = (int(value) for value in draft.rng.integers(0, 9, 4))
    noise = draft.rng.integers(
        0, draft.top + 1, (draft.stored.shape[0] + top + below, draft.stored.shape[1] + left + right, 1)
    )
    inner = noise.astype(draft.stored.dtype)
    inner[top : top + draft.stored.shape[0], left : left + draft.stored.shape[1]] = draft.stored
    draft.stored = inner
    return top, left


def cropped(draft: Draft) -> None:
    rows, cols, _ = draft.stored.shape
    top, left = padded(draft)
    draft.tags |= {50719: ("I", (left, top)), 50720: ("I", (cols, rows))}
    draft.names.append("default crop")


def with_margins(draft: Draft) -> None:
    rows, cols, _ = draft.stored.shape
    top, left = padded(draft)
    draft.tags[50829] = ("I", (top, left, top + rows, left + cols))
    draft.names.append("active area")


def black_of_sites(draft: Draft) -> None:
    """Add a black level to each of 2 x 2 sites, from the corner of the active area."""
    top, left = (int(value) for value in draft.tags.get(50829, ("I", (0, 0)))[1][:2])
    levels = draft.rng.integers(16, 80, (2, 2)) * 16
    rows, cols = (np.arange(size)[:, None] for size in draft.stored.shape[:2])
    excess = (levels - levels.min())[(rows - top) % 2, (cols.T - left) % 2][..., None]
    white = int(draft.tags[50717][1][0] + excess.max())
    if white < draft.top:
        draft.tags[50717] = ("I", (white,))
        draft.stored = (draft.stored + excess).astype(draft.stored.dtype)
        draft.tags |= {50713: ("H", (2, 2)), 50714: ("I", tuple(levels.ravel()))}
        draft.names.append("black level of each site")


def tabled(draft: Draft) -> None:
    """Store the place in a table of the occurring counts."""
    table, places = np.unique(draft.stored, return_inverse=True)
    draft.stored = places.reshape(draft.stored.shape).astype(draft.stored.dtype)
    draft.tags[50712] = ("H", tuple(table))
    draft.names.append("linearisation table")


REFUSED_DNG: dict[str, tuple[str, Callable[[Draft], None]]] = {
    "lossless jpeg": ("JPEG (TIFF compression 7), and its decoder is missing", tagged(259, "H", 7)),
    "lossy jpeg": ("which changes the counts", tagged(259, "H", 34892)),
    "quad mosaic": (
        "CFARepeatPatternDim 4 x 4",
        lambda draft: draft.tags.update(
            {262: ("H", (32803,)), 33421: ("H", (4, 4)), 33422: ("B", (0, 0, 1, 1) * 2 + (1, 1, 2, 2) * 2)}
        ),
    ),
    "filters of other colours": (
        "CFAPattern",
        lambda draft: draft.tags.update({262: ("H", (32803,)), 33421: ("H", (2, 2)), 33422: ("B", (3, 4, 5, 1))}),
    ),
    "layout": ("CFALayout", tagged(50711, "H", 2)),
    "scale": ("DefaultScale", tagged(50718, "2I", 2, 1, 1, 1)),
    "opcodes": ("OpcodeList2", tagged(51009, "B", 0, 0, 0, 1, 0, 0, 0, 9)),
    "zero white": ("WhiteLevel", tagged(50717, "I", 0)),
    "white below black": (
        "below the BlackLevel",
        lambda draft: draft.tags.update({50714: ("I", (900,)), 50717: ("I", (800,))}),
    ),
    "area outside": ("ActiveArea", tagged(50829, "I", 0, 0, 900, 900)),
    "half a pixel": ("DefaultCropOrigin", tagged(50719, "2I", 1, 2, 3, 1)),
    "blacks that do not fit": ("BlackLevel", tagged(50714, "I", 1, 2, 3)),
    "user crop": ("DefaultUserCrop", tagged(51125, "2I", 0, 1, 0, 1, 1, 2, 1, 1)),
    "interleaved": ("RowInterleaveFactor", tagged(50975, "I", 2)),
    "grey only": ("no raw image", tagged(262, "H", 1)),
}


def refused_dng(rng: np.random.Generator) -> Encoded:
    """Return a DNG with one property that is not applied."""
    name = str(rng.choice(list(REFUSED_DNG)))
    draft = plain(rng, "u16")
    draft.tags |= {262: ("H", (34892,)), 50706: ("B", (1, 4, 0, 0))}
    word, apply = REFUSED_DNG[name]
    apply(draft)
    return Encoded(".dng", draft.written(), draft.meant, [name], word)


# PNG


def png_bytes(lines: Pixels, cols: int, depth: int, colour: int, chunks: dict[bytes, bytes]) -> bytes:
    """Return a PNG of rows of bytes, with chunks before the image."""
    header = struct.pack(">IIBBBBB", cols, len(lines), depth, colour, 0, 0, 0)
    packed = zlib.compress(b"".join(b"\0" + line.tobytes() for line in lines))
    parts = {b"IHDR": header, **chunks, b"IDAT": packed, b"IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts.items()
    )


def exif(orientation: int) -> bytes:
    return tiff_bytes([([], {274: ("H", (orientation,))})], ">", big=False)


def random_png(rng: np.random.Generator) -> Encoded:
    """Return a PNG: grey of 2 to 16 bits, colour, palette or opaque alpha, upright or not."""
    kind, colour = str(rng.choice(["u2", "u4", "u8", "u16"])), bool(rng.random() < 0.4)
    depth = int(kind[1:])
    colour = colour and depth >= 8
    meant = counts(rng, kind, colour)
    orientation = int(rng.integers(1, 9))
    image = stored(meant, orientation)
    names, chunks = (
        [f"png {kind}", f"orientation {orientation}"],
        {b"eXIf": exif(orientation), b"gAMA": struct.pack(">I", 100000)},
    )
    mode = 2 if colour else 0
    if not colour and depth == 8 and rng.random() < 0.5:
        order, mode = rng.permutation(256), 3
        image, table = order[image], np.zeros((256, 3), np.uint8)
        table[order] = np.arange(256)[:, None]
        chunks[b"PLTE"] = table.tobytes()
        names.append("palette")
    elif depth == 8 and rng.random() < 0.4:
        image, mode = (
            np.concatenate([image.reshape(*image.shape[:2], -1), np.full((*image.shape[:2], 1), 255)], 2),
            mode + 4,
        )
        names.append("opaque alpha")
    elif depth == 16 and rng.random() < 0.5:
        image = (image << np.uint16(4)) | (image >> np.uint16(8))
        chunks[b"sBIT"] = bytes([12]) * (3 if colour else 1)
        names.append("12 significant bits")
    cols = image.shape[1]
    bits = (image.reshape(len(image), -1, 1).astype(np.uint16) >> np.arange(depth - 1, -1, -1)) & 1
    lines = np.packbits(bits.reshape(len(image), -1).astype(np.uint8), axis=1)
    return Encoded(".png", png_bytes(lines, cols, depth, mode, chunks), meant, names)


REFUSED_PNG: dict[str, tuple[str, int, int, dict[bytes, bytes]]] = {  # the word, depth, colour type and chunks
    "gamma": ("gAMA", 8, 0, {b"gAMA": struct.pack(">I", 45455)}),
    "srgb": ("sRGB", 8, 0, {b"sRGB": b"\0"}),
    "animation": ("acTL", 8, 0, {b"acTL": struct.pack(">II", 2, 0)}),
    "one bit": ("one bit", 1, 0, {}),
    "16 bits with alpha": ("16 bits with an alpha channel", 16, 6, {}),
    "grey and alpha of 16 bits": ("16 bits with an alpha channel", 16, 4, {}),
    "transparent": ("transparent", 8, 6, {}),
    "key colour": ("transparent", 16, 0, {b"tRNS": b"\x12\x34"}),
    "transparent palette": ("transparent", 8, 3, {b"PLTE": bytes(range(256)) * 3, b"tRNS": b"\0" * 256}),
    "orientation 9": ("orientation 9", 8, 0, {b"eXIf": exif(9)}),
}


def refused_png(rng: np.random.Generator) -> Encoded:
    """Return a PNG with one property that is not applied."""
    name = str(rng.choice(list(REFUSED_PNG)))
    word, depth, colour, chunks = REFUSED_PNG[name]
    rows, cols = (int(value) for value in rng.integers(33, 90, 2))
    width = -(-cols * depth * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour] // 8)
    lines = rng.integers(0, 256, (rows, width)).astype(np.uint8)
    lines[0, :2] = 0x12, 0x34
    return Encoded(".png", png_bytes(lines, cols, depth, colour, chunks), lines, [name], word)


# numpy


def random_array(rng: np.random.Generator) -> Encoded:
    """Return an npy or npz of any number type, byte order and memory order."""
    kind = str(rng.choice([kind for kind in KINDS if kind not in ("u2", "u4", "u10", "u12", "u14")] + ["u64", "i64"]))
    meant = counts(rng, kind, bool(rng.random() < 0.25))
    array = np.asarray(meant, order="F" if rng.random() < 0.5 else "C")
    array = array.astype(array.dtype.newbyteorder(str(rng.choice(["<", ">"]))))
    return _array_file(rng, array, meant, [f"array {array.dtype.str}"], None)


def refused_array(rng: np.random.Generator) -> Encoded:
    """Return an npy or npz of values that are no counts."""
    name = str(rng.choice(["complex128", "bool", "object", "<U3", "datetime64[s]"]))
    grey = counts(rng, "u8")
    array = grey.astype(np.int64).astype(name) if name != "<U3" else grey.astype(name)
    return _array_file(rng, array, grey, [f"array {name}"], {"<U3": "<U3"}.get(name, name))


def _array_file(
    rng: np.random.Generator, array: Pixels, meant: Pixels, names: list[str], refused: str | None
) -> Encoded:
    out, packed = BytesIO(), bool(rng.random() < 0.4)
    if packed:
        (np.savez_compressed if rng.random() < 0.5 else np.savez)(out, picture=array)
    else:
        np.save(out, array)
    return Encoded(".npz" if packed else ".npy", out.getvalue(), meant, names, refused)


WRITERS = (
    random_tiff,
    random_tiff,
    random_tiff,
    refused_tiff,
    random_dng,
    random_dng,
    refused_dng,
    random_png,
    refused_png,
    random_array,
    refused_array,
)


def encoded_images(seed: int, n: int) -> Iterator[Encoded]:
    """Return n random files."""
    for index in range(n):
        rng = np.random.default_rng((seed, index))
        yield WRITERS[index % len(WRITERS)](rng)


def difference(file: Encoded, folder: Path) -> str | None:
    """Return what is wrong with the reading of a file; None if its pixels are those meant, or it is refused by name."""
    path = folder / f"image{file.suffix}"
    path.write_bytes(file.data)
    try:
        read = read_counts_file(path)
    except FrameError as error:
        if file.refused is not None and file.refused in error.message:
            return None
        return f"{file.names}: {error.message}"
    if file.refused is not None:
        return f"{file.names}: read, and not refused with '{file.refused}'"
    (pixels,) = read.frames
    if pixels.dtype.kind != file.meant.dtype.kind or not np.array_equal(pixels, file.meant):
        return f"{file.names}: {pixels.dtype} {pixels.shape} instead of {file.meant.dtype} {file.meant.shape}"
    levels = (read.levels.bayer, read.levels.black_dn, read.levels.white_dn)
    return None if levels == file.levels else f"{file.names}: levels {levels} instead of {file.levels}"


def main(n: int) -> int:
    """Print how many files had each property, and every difference; return the number of differences."""
    seen: Counter[str] = Counter()
    wrong = []
    with TemporaryDirectory() as folder:
        for file in encoded_images(0, n):
            seen.update([*file.names, "refused by name" if file.refused else "read"])
            wrong += [found] if (found := difference(file, Path(folder))) else []
    lines = [*(f"{count:5d}  {name}" for name, count in seen.most_common()), *wrong]
    sys.stdout.write("\n".join([*lines, f"{n} files, {len(wrong)} differences"]) + "\n")
    return len(wrong)


if __name__ == "__main__":
    sys.exit(min(main(int(sys.argv[1]) if len(sys.argv) > 1 else 500), 1))
