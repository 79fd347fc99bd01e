"""Strips and tiles of a TIFF image: decompression, packed bits, byte order and predictor, to the stored values.

tifffile finds the segments. Its decoders are in imagecodecs, a package of 50 MB that is not installed: Pillow's libtiff
decompresses instead, as one byte per sample, and the values are unpacked here (TIFF 6.0; predictor 3: Adobe Photoshop
TIFF Technical Note 3).
"""

import struct
import zlib
from io import BytesIO
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import features

from device.errors import FrameError

Pixels = NDArray[Any]
MAX_PIXELS = 2**27  # a quarter of a gigabyte of counts: more is a mistake or an attack
MAX_COMPRESSION_RATIO = 1100  # maximum compression ratio of a deflated black frame (zlib: 1032)
_NONE, _LZW, _DEFLATE, _OLD_DEFLATE, _PACK_BITS, _LZMA, _ZSTD = 1, 5, 8, 32946, 32773, 34925, 50000
_LOSSY = (6, 34892)  # JPEG: with loss, but for raw images, in which it is lossless
_JPEG = 7
_OF_RAW = (tifffile.PHOTOMETRIC.CFA, tifffile.PHOTOMETRIC.LINEAR_RAW)
_OF_LIBTIFF = (_LZW, _PACK_BITS, _LZMA, _ZSTD)
_PREDICTED = (_LZW, _DEFLATE, _OLD_DEFLATE, _LZMA, _ZSTD)  # codecs that a predictor may precede
_KINDS = {1: "u", 2: "i", 3: "f", 4: "u"}  # of SampleFormat; "undefined" (4) is read as unsigned (TIFF 6.0, page 80)
_WHOLE_BITS = {"u": (8, 16, 32, 64), "i": (8, 16, 32, 64), "f": (16, 32, 64)}


def stored_values(page: tifffile.TiffPage, name: str) -> Pixels:
    """Return the stored values of a page, (rows, cols) or (rows, cols, samples), in native byte order.

    Counts of 2 to 15 bits become uint8 or uint16. FrameError names a property that cannot be decoded; ValueError for
    missing data.
    """
    dtype = _dtype(page, name)
    _refuse_coding(page, name)
    rows = page.imagelength
    cols = page.imagewidth
    samples = page.samplesperpixel
    planes, in_segment = (samples, 1) if page.planarconfig == 2 else (1, samples)
    height = page.tilelength if page.is_tiled else min(page.rowsperstrip, rows)
    width = page.tilewidth if page.is_tiled else cols
    grid = (planes, -(-rows // height), -(-cols // width))
    _require_size(page, grid, height * width * in_segment)
    values = np.empty((rows, cols, samples), dtype)
    for index, (plane, row, col) in enumerate(np.ndindex(grid)):
        top = row * height
        left = col * width
        # a tile is stored whole, the last strip only as far as the image goes
        stored_rows = height if page.is_tiled else min(height, rows - top)
        lines = _lines(page, index, stored_rows, width * in_segment)
        block = _unpacked(page, lines, dtype, width * in_segment).reshape(stored_rows, width, in_segment)
        target = values[top : top + height, left : left + width, plane : plane + in_segment]
        target[:] = _unpredicted(page, block)[: target.shape[0], : target.shape[1]]
    return values[..., 0] if samples == 1 else values


def _dtype(page: tifffile.TiffPage, name: str) -> np.dtype[Any]:
    """Return the type of the values in native byte order; FrameError for a type that is no count."""
    tag = page.tags.get("SampleFormat")
    formats = {int(value) for value in (tag.value if isinstance(tag.value, tuple) else (tag.value,))} if tag else {1}
    bits = page.bitspersample
    kind = _KINDS.get(min(formats), "")
    if not isinstance(bits, int) or len(formats) > 1:
        raise FrameError(
            f"{name} has channels of different types (BitsPerSample {bits}, SampleFormat {sorted(formats)})",
            "Save all channels with the same number of bits.",
        )
    if bits == 1:
        raise FrameError(f"{name} holds one bit for each pixel, which is no count", "Save the counts of the sensor.")
    if kind == "u" and 1 < bits < 16:
        return np.dtype(np.uint8 if bits <= 8 else np.uint16)
    if bits not in _WHOLE_BITS.get(kind, ()):
        what = "complex numbers" if formats & {5, 6} else "numbers"
        raise FrameError(
            f"{name} holds {what} of {bits} bits (SampleFormat {min(formats)}), which are not read",
            "Save whole numbers of 8 or 16 bits, or float of 32 bits.",
        )
    return np.dtype(f"{kind}{bits // 8}")


def _refuse_coding(page: tifffile.TiffPage, name: str) -> None:
    """Raise FrameError for a compression, predictor or bit order that cannot be undone."""
    code = int(page.compression)
    remedy = "Save it without compression, or with LZW or deflate."
    if code in _LOSSY or (code == _JPEG and page.photometric not in _OF_RAW):
        raise FrameError(f"{name} is compressed by {_codec(code)}, which changes the counts", remedy)
    if code not in (_NONE, *_PREDICTED, *_OF_LIBTIFF) or (code in _OF_LIBTIFF and not features.check("libtiff")):
        raise FrameError(f"{name} is compressed by {_codec(code)}, and its decoder is missing here", remedy)
    predictor = int(page.predictor)
    whole = page.bitspersample in (8, 16, 32, 64)
    fitting = predictor == 1 or (predictor == 2 and whole) or (predictor == 3 and page.sampleformat == 3)
    if not fitting or (predictor != 1 and code not in _PREDICTED):
        raise FrameError(
            f"{name} has predictor {predictor} with {page.bitspersample} bits and {_codec(code)}, which is not read",
            remedy,
        )
    if page.fillorder != 1 and code != _NONE:
        raise FrameError(f"{name} is compressed with reversed bits (FillOrder {page.fillorder})", remedy)


def _codec(code: int) -> str:
    try:
        word = tifffile.COMPRESSION(code).name
    except ValueError:
        word = "an unknown method"
    return f"{word} (TIFF compression {code})"


def _require_size(page: tifffile.TiffPage, grid: tuple[int, int, int], segment: int) -> None:
    """Raise ValueError for a header that claims more data than the file or MAX_PIXELS allow, or lists too few segments.

    Decoding such a file would take minutes and all memory.
    """
    segments = int(np.prod(grid))
    stored = sum(page.databytecounts)
    if segments < 1 or segment < 1 or min(len(page.dataoffsets), len(page.databytecounts)) < segments:
        raise ValueError(f"{segments} strips or tiles are needed, and {len(page.dataoffsets)} are listed")
    claimed = segments * segment * int(page.bitspersample) // 8
    if segments * segment > 3 * MAX_PIXELS or claimed > MAX_COMPRESSION_RATIO * stored + segment * 8:
        raise ValueError(f"{stored} bytes cannot hold the {claimed} that it promises")


def _lines(page: tifffile.TiffPage, index: int, rows: int, samples: int) -> NDArray[np.uint8]:
    """Return the decompressed bytes of a segment, (rows, bytes of a row); ValueError if some are missing."""
    file = page.parent.filehandle
    bits = int(page.bitspersample)
    file.seek(page.dataoffsets[index])
    data = file.read(page.databytecounts[index])
    if len(data) < page.databytecounts[index]:
        raise ValueError(f"of {page.databytecounts[index]} bytes of strip or tile {index}, {len(data)} are there")
    line_bytes = -(-samples * bits // 8)
    data = _decompressed(data, int(page.compression), rows, line_bytes)
    if len(data) < rows * line_bytes:
        raise ValueError(f"strip or tile {index} has {len(data)} bytes of {rows * line_bytes}")
    lines = np.frombuffer(data, np.uint8, rows * line_bytes).reshape(rows, line_bytes)
    if page.fillorder == 2:
        return np.packbits(np.unpackbits(lines, axis=1, bitorder="little"), axis=1)
    return lines


def _decompressed(data: bytes, code: int, rows: int, line_bytes: int) -> bytes:
    """Return the bytes of a segment; ValueError or OSError if they are damaged.

    libtiff reads them as the single strip of a grey image of one byte for each pixel.
    """
    if code == _NONE:
        return data
    if code in (_DEFLATE, _OLD_DEFLATE):
        return zlib.decompressobj().decompress(data, rows * line_bytes + 1)
    tags = {
        256: line_bytes,
        257: rows,
        258: 8,
        259: code,
        262: 1,
        273: 8 + 2 + 9 * 12 + 4,
        277: 1,
        278: rows,
        279: len(data),
    }
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    header = struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + directory + bytes(4)
    with Pillow.open(BytesIO(header + data), formats=("TIFF",)) as picture:
        return picture.tobytes()


def _unpacked(page: tifffile.TiffPage, lines: NDArray[np.uint8], dtype: np.dtype[Any], samples: int) -> Pixels:
    """Return the values in the rows of a segment, (rows, samples), with the predictor still applied."""
    bits = int(page.bitspersample)
    if int(page.predictor) == 3:  # differences of bytes, the most significant bytes of a row first
        step = 1 if page.planarconfig == 2 else page.samplesperpixel
        summed = np.cumsum(lines.reshape(len(lines), -1, step), axis=1, dtype=np.uint8)
        ordered = summed.reshape(len(lines), bits // 8, samples).transpose(0, 2, 1)
        return np.ascontiguousarray(ordered).view(dtype.newbyteorder(">"))[..., 0].astype(dtype)
    if bits in (8, 16, 32, 64):
        return np.asarray(lines.view(dtype.newbyteorder(page.parent.byteorder)).astype(dtype, copy=False))
    single = np.unpackbits(lines, axis=1, count=samples * bits).reshape(len(lines), samples, bits)
    values = np.zeros((len(lines), samples), dtype)
    for bit in range(bits):  # the most significant bit first, whatever the byte order of the file
        values = (values << 1) | single[..., bit]
    return values


def _unpredicted(page: tifffile.TiffPage, block: Pixels) -> Pixels:
    """Return (rows, cols, samples) values of which horizontal differences (predictor 2) were stored."""
    if int(page.predictor) != 2:
        return block
    whole = np.dtype(f"u{block.dtype.itemsize}")
    return np.cumsum(block.view(whole), axis=1, dtype=whole).view(block.dtype)
