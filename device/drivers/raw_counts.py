"""Conversion of raw frame bytes to counts: row padding and justification are removed, and nothing else.

A camera delivers rows of `stride` bytes with undefined padding on the right. A Raspberry Pi 4 stores a sensor's bits at
the low end of each 16-bit word (`R10`, `R12`), a Pi 5 at the high end (`R16`); `RawLayout.check` verifies this.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraMismatch, CameraPacked
from device.values import Counts

Bytes = NDArray[np.uint8]

PLAIN = re.compile(r"(?:R|S(?:RGGB|GRBG|GBRG|BGGR))(8|10|12|14|16)")
V4L2_BITS = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y16 ": 16}


@dataclass(frozen=True)
class RawLayout:
    """Layout of raw frame bytes: a word of `word_bits` per pixel, with `bit_depth` bits shifted left by `shift`."""

    name: str
    rows: int
    cols: int
    bit_depth: int
    word_bits: int = 16
    shift: int = 0

    @property
    def row_bytes(self) -> int:
        """Return the number of bytes of a row without its padding."""
        return self.cols * self.word_bits // 8

    def words(self, raw: Bytes) -> NDArray[np.uint16] | Bytes:
        """Return the pixel words (rows, cols) as a view of `raw` (rows, stride), never a copy.

        Raises CameraMismatch if the buffer is too small.
        """
        if raw.ndim != 2 or raw.shape[0] < self.rows or raw.shape[1] < self.row_bytes:
            raise CameraMismatch(
                f"a raw buffer of {raw.shape} bytes cannot hold {self.rows} x {self.cols} of {self.name}"
            )
        pixels = raw[: self.rows, : self.row_bytes]
        return pixels if self.word_bits == 8 else pixels.view(np.uint16)

    def counts(self, raw: Bytes, out: Counts) -> Counts:
        """Write the counts of a frame, DN of the sensor, to `out` uint16 (rows, cols); return it. CameraMismatch."""
        words = self.words(raw)
        if self.shift:
            np.right_shift(words, self.shift, out=out)
        else:
            np.copyto(out, words)
        return out

    def check(self, raw: Bytes) -> None:
        """Raise CameraMismatch if all counts are zero, or if a bit is set outside the layout's `bit_depth` bits.

        Used on the first frame after a start, because the driver's format name does not prove the justification; noise
        sets every bit that a sensor has.
        """
        bits = used_bits(self.words(raw))
        if bits == 0:
            raise CameraMismatch(f"every count of the {self.name} frame is zero: there is not even a black level")
        if bits & ((1 << self.shift) - 1):
            raise CameraMismatch(
                f"{self.name}: the lowest {self.shift} bits should be empty for a {self.bit_depth}-bit sensor, "
                f"and are not ({bits:#06x})"
            )
        if bits >> self.shift >= 1 << self.bit_depth:
            raise CameraMismatch(f"{self.name}: counts beyond {self.bit_depth} bits ({bits:#06x})")


def used_bits(words: NDArray[np.uint16] | Bytes) -> int:
    """Return the bitwise OR of all pixel words."""
    return int(np.bitwise_or.reduce(words, axis=None))


def pi_layout(name: str, rows: int, cols: int, bit_depth: int) -> RawLayout:
    """Return the layout of a raw format granted by libcamera.

    A 16-bit format of a sensor with fewer bits is left-justified (Raspberry Pi 5); the others are right-justified.
    Errors: CameraPacked for a packed, compressed or unknown format; CameraMismatch for a wrong number of bits.
    """
    known = PLAIN.fullmatch(name)
    if known is None:
        kind = "compressed, with loss" if "COMP" in name else "packed" if "CSI2P" in name else "unknown"
        raise CameraPacked(f"the camera grants the raw format {name} only, which is {kind}")
    bits = int(known[1])
    if bits == 8:
        return _fitting(RawLayout(name, rows, cols, bit_depth, word_bits=8), bits)
    return _fitting(RawLayout(name, rows, cols, bit_depth, shift=bits - bit_depth if bits == 16 else 0), bits)


def v4l2_layout(fourcc: str, rows: int, cols: int, bit_depth: int) -> RawLayout:
    """Return the layout of GREY, Y10, Y12 or Y16 (right-justified); else CameraPacked. CameraMismatch: other bits."""
    bits = V4L2_BITS.get(fourcc)
    if bits is None:
        raise CameraPacked(
            f"the camera grants the pixel format {fourcc!r} only",
            f"Choose a camera, or a mode of it, with one of {', '.join(name.strip() for name in V4L2_BITS)}.",
        )
    return _fitting(RawLayout(fourcc, rows, cols, bit_depth, word_bits=8 if bits == 8 else 16), bits)


def _fitting(layout: RawLayout, bits: int) -> RawLayout:
    """Return the layout; CameraMismatch unless the format's `bits` are 16 or exactly the bit depth of the head file."""
    if bits != layout.bit_depth and bits != 16:
        raise CameraMismatch(f"the camera grants {layout.name}, and the head's file says {layout.bit_depth} bits")
    return layout


def black_dn(level: float, bit_depth: int) -> float:
    """Return a black level of libcamera's 16-bit scale (`SensorBlackLevels`) in DN: 3840 is 60 at 10 bits."""
    return float(level / 2 ** (16 - bit_depth))
