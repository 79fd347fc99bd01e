"""From the bytes of a raw frame to a sensor's counts: cropped to its pixels, justified, checked; nothing packed."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraMismatch
from device.values import Counts

WORD_BITS = 16
UNPACKED = re.compile(r"^(?:R|S[RGB]{4}|Y|GREY)(8|10|12|14|16)?$")


@dataclass(frozen=True)
class RawLayout:
    """How counts of `bits` lie in rows of `stride` bytes: (rows, cols) words, shifted up by `shift` bits."""

    rows: int
    cols: int
    bits: int
    stride: int
    shift: int
    word: int = 2

    @classmethod
    def of(cls, name: str, shape: tuple[int, int], stride: int, bits: int) -> "RawLayout":
        """The layout of a granted format, such as `R10` (counts in the low bits) or `R16` (in the high ones).

        Raises CameraMismatch for a packed or compressed format, or one that cannot hold the sensor's bits.
        """
        known = UNPACKED.match(name)
        if known is None:
            raise CameraMismatch(
                f"the camera gives {name}, which is packed or compressed",
                "This camera or its driver gives no plain counts. Use another camera mode; call the technician.",
            )
        depth = 8 if name == "GREY" else int(known[1] or WORD_BITS)
        word = 1 if depth == 8 else 2
        rows, cols = shape
        if depth < bits or stride < cols * word:
            raise CameraMismatch(f"{name} in rows of {stride} bytes cannot hold {cols} counts of {bits} bits")
        shift = WORD_BITS - bits if depth == WORD_BITS else 0
        if depth not in (bits, WORD_BITS):
            raise CameraMismatch(f"the camera gives {depth} bits, the head file says {bits}")
        return cls(rows, cols, bits, stride, shift, word)

    def words(self, raw: NDArray[np.uint8]) -> NDArray[np.unsignedinteger[Any]]:
        """The words of the pixels, without a copy, from (rows, stride) or more bytes: the padding is garbage."""
        plain = raw.reshape(-1)[: self.rows * self.stride].reshape(self.rows, self.stride)
        words: NDArray[np.unsignedinteger[Any]] = plain.view(np.uint16 if self.word == 2 else np.uint8)
        return words[:, : self.cols]

    def unpack(self, raw: NDArray[np.uint8], out: Counts) -> Counts:
        """Fill `out` (rows, cols) with counts."""
        if self.shift:
            np.right_shift(self.words(raw), np.uint16(self.shift), out=out)
        else:
            out[:] = self.words(raw)
        return out

    def used_bits(self, raw: NDArray[np.uint8]) -> int:
        """All words of a frame, or-ed."""
        return int(np.bitwise_or.reduce(self.words(raw), axis=None))

    def check(self, used: int) -> None:
        """Raise CameraMismatch if the used bits of a frame show that its words are not as this layout says."""
        low = (1 << (WORD_BITS - self.bits)) - 1
        if self.shift and used & low:
            raise CameraMismatch(f"counts of {self.bits} bits should leave the low {self.shift} bits of a word empty")
        if not self.shift and low and self.word == 2 and used and not used & low:  # noise would fill the lowest bits
            raise CameraMismatch(f"counts of {self.bits} bits stand at the upper end of their words, not at the lower")
        if used >> self.shift >= 1 << self.bits:
            raise CameraMismatch(f"counts of {self.bits} bits do not reach {used >> self.shift}")
