"""Time in planned FFT pairs of the frame's grid, and what it would be on a Raspberry Pi 5 by a stated factor.

A solver takes mostly FFTs, so its time over that of one pair hardly depends on the machine. The factor of a Raspberry
Pi 5 is stated, not measured; `make bench-pi` prints that of the machine on which it runs.
"""

from math import log2
from typing import NamedTuple

from device.clock import Clock
from device.recon.model.fft_plans import Planner

REFERENCE_SHAPE = (1080, 1920)
REFERENCE_PAIR_S = 0.015  # on one core of the development machine, device/decisions/0002-numba-for-fused-passes.md
PI5_FACTOR = 4.0  # of a pair on a Raspberry Pi 5 over that [estimate: 2.4 GHz, 128-bit vectors; not measured]
REPEATS = 5


def pair_s(planner: Planner, shape: tuple[int, int], clock: Clock, repeats: int = REPEATS) -> float:
    """Return the duration of a forward and inverse FFT of `shape` in s, the shortest of `repeats`: load only adds."""
    fft = planner.plan(shape)
    shortest_s = float("inf")
    for _ in range(repeats):
        begin_s = clock.now_s()
        fft.forward()
        fft.inverse()
        shortest_s = min(shortest_s, clock.now_s() - begin_s)
    return shortest_s


def pi5_s(fft_pairs: float, shape: tuple[int, int]) -> float:
    """Return the time of FFT pairs of `shape` (rows, cols) on a Raspberry Pi 5 in s, by the stated factor."""
    work, reference = (size * log2(size) for size in (shape[0] * shape[1], REFERENCE_SHAPE[0] * REFERENCE_SHAPE[1]))
    return fft_pairs * PI5_FACTOR * REFERENCE_PAIR_S * work / reference


class FftTime(NamedTuple):
    """Duration in s of one planned FFT pair of a grid `shape` (rows, cols)."""

    seconds: float
    shape: tuple[int, int]

    @classmethod
    def measured(cls, planner: Planner, shape: tuple[int, int], clock: Clock) -> "FftTime":
        """Return the duration of a pair of this shape, measured now."""
        return cls(pair_s(planner, shape, clock), shape)

    def times(self, seconds: float) -> tuple[float, float, float]:
        """Return a time in s, in FFT pairs, and in s on a Raspberry Pi 5 by the stated factor."""
        return seconds, seconds / self.seconds, pi5_s(seconds / self.seconds, self.shape)
