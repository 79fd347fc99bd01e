"""From the bytes of a raw frame to counts: the padding cut off, the justification undone, nothing else touched.

A camera hands over rows of `stride` bytes, of which the right margin is garbage. A Raspberry Pi 4 keeps a sensor's bits
at the low end of each 16-bit word (`R10`, `R12`); a Pi 5 keeps them at the high end (`R16`). `seen_bits` tells which.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraPacked, CameraWrong
from device.values import Counts

Bytes = NDArray[np.uint8]

PLAIN = re.compile(r"(?:R|S(?:RGGB|GRBG|GBRG|BGGR))(8|10|12|14|16)")
V4L2_BITS = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y16 ": 16}


@dataclass(frozen=True)
class RawLayout:
    """How the counts of one sensor lie in its rows: `word_bits` per pixel, `shift` below the lowest one that counts."""

    name: str
    rows: int
    cols: int
    bit_depth: int
    word_bits: int = 16
    shift: int = 0

    @property
    def row_bytes(self) -> int:
        """Bytes of a row without its padding."""
        return self.cols * self.word_bits // 8

    def words(self, raw: Bytes) -> NDArray[np.uint16] | Bytes:
        """The words of the pixels (rows, cols) as they lie in `raw` (rows, stride); a view, never a copy.

        Raises CameraWrong if the rows are shorter than the picture.
        """
        if raw.ndim != 2 or raw.shape[0] < self.rows or raw.shape[1] < self.row_bytes:
            raise CameraWrong(f"a raw buffer of {raw.shape} bytes cannot hold {self.rows} x {self.cols} of {self.name}")
        pixels = raw[: self.rows, : self.row_bytes]
        return pixels if self.word_bits == 8 else pixels.view(np.uint16)

    def counts(self, raw: Bytes, out: Counts) -> Counts:
        """The counts of a frame, in DN of the sensor, into `out` uint16 (rows, cols), which is returned."""
        words = self.words(raw)
        if self.shift:
            np.right_shift(words, self.shift, out=out)
        else:
            np.copyto(out, words)
        return out

    def check(self, raw: Bytes) -> None:
        """Refuse a frame whose bits are not where this layout says; noise sets every bit that a sensor has.

        Raises CameraWrong. For the first frame after the start: the driver's word for the justification is not enough.
        """
        bits = seen_bits(self.words(raw))
        if bits == 0:
            raise CameraWrong(f"every count of the {self.name} frame is zero: there is not even a black level")
        if bits & ((1 << self.shift) - 1):
            raise CameraWrong(
                f"{self.name}: the lowest {self.shift} bits should be empty for a {self.bit_depth}-bit sensor, "
                f"and are not ({bits:#06x})"
            )
        if bits >> self.shift >= 1 << self.bit_depth:
            raise CameraWrong(f"{self.name}: counts beyond {self.bit_depth} bits ({bits:#06x})")


def seen_bits(words: NDArray[np.uint16] | Bytes) -> int:
    """Every bit that any of the pixels has set."""
    return int(np.bitwise_or.reduce(words, axis=None))


def pi_layout(name: str, rows: int, cols: int, bit_depth: int) -> RawLayout:
    """The layout of a format that libcamera granted; CameraPacked for packed or compressed ones, by their name.

    A 16-bit format of a sensor with fewer bits is at the high end (Raspberry Pi 5); the others are at the low end.
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
    """The layout of a V4L2 pixel format (GREY, Y10, Y12, Y16: low end); CameraPacked for any other, by its name."""
    bits = V4L2_BITS.get(fourcc)
    if bits is None:
        raise CameraPacked(
            f"the camera grants the pixel format {fourcc!r} only",
            f"Choose a camera, or a mode of it, with one of {', '.join(name.strip() for name in V4L2_BITS)}.",
        )
    return _fitting(RawLayout(fourcc, rows, cols, bit_depth, word_bits=8 if bits == 8 else 16), bits)


def _fitting(layout: RawLayout, bits: int) -> RawLayout:
    """A 16-bit word may hold any sensor; a smaller format must be as deep as the head says."""
    if bits != layout.bit_depth and bits != 16:
        raise CameraWrong(f"the camera grants {layout.name}, and the head's file says {layout.bit_depth} bits")
    return layout


def black_dn(level: float, bit_depth: int) -> float:
    """A black level on libcamera's 16-bit scale (`SensorBlackLevels`) in DN of the sensor: 3840 is 60 at 10 bits."""
    return float(level / 2 ** (16 - bit_depth))
