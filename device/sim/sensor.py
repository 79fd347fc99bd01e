"""Electrons that arrive become counts that are read: shot noise, full well, read noise, gain, black level, converter.

optics.md 3.9: DN = round(black + min(bent(Poisson(e) + read + offset), well) / gain).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from device.spec import CameraSpec
from device.values import Counts, Image

# Above this mean a Gaussian of the same mean and variance stands for the Poisson law. Their distribution functions then
# differ by at most 0.3041 / sqrt(mean) (Shevtsova 2014, Berry-Esseen for Poisson) = 0.03; below it the draw is exact.
GAUSSIAN_FROM_E = 100.0
STRIP_ROWS = 64
ENDLESS_DN = 65535  # what uint16 holds


@dataclass(frozen=True)
class SensorModel:
    """What turns electrons into counts, in the units of a head's [camera] table.

    `offset_e` (rows, cols) is a fixed pattern; `nonlinearity` the relative bend at `bends_at_e`.
    """

    gain_e_per_dn: float
    black_dn: float
    white_dn: int
    full_well_e: float
    read_noise_e: float
    shot: bool = True
    nonlinearity: float = 0.0
    bends_at_e: float = 1.0
    offset_e: Image | None = field(default=None, repr=False)

    @classmethod
    def of(cls, camera: CameraSpec) -> "SensorModel":
        """The sensor that a head's file describes."""
        return cls(camera.gain_e_per_dn, camera.black_dn, camera.white_dn, camera.full_well_e, camera.read_noise_e)

    @classmethod
    def ideal(cls, camera: CameraSpec) -> "SensorModel":
        """The same without noise, and with wells and a converter that have no end: whole counts are left of it."""
        well_e = camera.full_well_e
        return cls(camera.gain_e_per_dn, camera.black_dn, ENDLESS_DN, float("inf"), 0.0, False, 0.0, well_e)

    def offset_by(self, pattern_e: Image) -> "SensorModel":
        """With a fixed pattern more."""
        return replace(self, offset_e=pattern_e if self.offset_e is None else self.offset_e + pattern_e)

    def middle(self, shape: tuple[int, int]) -> "SensorModel":
        """Only the pixels (rows, cols) in the middle."""
        if self.offset_e is None:
            return self
        rows, cols = (
            slice(have // 2 - n // 2, have // 2 - n // 2 + n)
            for have, n in zip(self.offset_e.shape, shape, strict=True)
        )
        return replace(self, offset_e=self.offset_e[rows, cols])

    def read(self, electrons: Image, seed: int | tuple[int, ...], into: Counts | None = None) -> Counts:
        """One noisy frame of the expected `electrons` (rows, cols): uint16, the same for the same seed.

        `into` is filled and returned if it is given. Strips of 64 rows have noise of their own, so the frame does not
        depend on how many threads share the work.
        """
        counts = np.empty(electrons.shape, np.uint16) if into is None else into
        starts = range(0, electrons.shape[0], STRIP_ROWS)
        streams = np.random.SeedSequence(seed).spawn(len(starts))
        with ThreadPoolExecutor(2) as pool:
            strips = [
                pool.submit(self._read_strip, electrons, slice(r, r + STRIP_ROWS), stream, counts)
                for r, stream in zip(starts, streams, strict=True)
            ]
            for strip in strips:
                strip.result()
        return counts

    def _read_strip(self, electrons: Image, rows: slice, stream: np.random.SeedSequence, counts: Counts) -> None:
        rng = np.random.Generator(np.random.SFC64(stream))
        if self.shot:
            level = noisy(electrons[rows], self.read_noise_e, rng)
        else:
            level = electrons[rows] + np.float32(self.read_noise_e) * rng.standard_normal(electrons[rows].shape, "f4")
        if self.offset_e is not None:
            level += self.offset_e[rows]
        if self.nonlinearity:
            level *= 1 + level * np.float32(self.nonlinearity / self.bends_at_e)
        if self.full_well_e < np.inf:
            np.minimum(level, np.float32(self.full_well_e), out=level)
        level *= np.float32(1 / self.gain_e_per_dn)
        level += np.float32(self.black_dn)
        np.rint(level, out=level)
        np.clip(level, 0, self.white_dn, out=level)
        np.copyto(counts[rows], level, casting="unsafe")


def noisy(electrons: Image, read_noise_e: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """What is read when `electrons` (not negative) are expected: shot noise and read noise, float32 electrons.

    Below 100 electrons the Poisson draw is exact. Above, one Gaussian stands for both noises.
    """
    few = electrons < GAUSSIAN_FROM_E
    variance = np.where(few, 0, electrons) + np.float32(read_noise_e**2)
    level = rng.standard_normal(electrons.shape, dtype=np.float32)
    level *= np.sqrt(variance, out=variance)
    level += np.where(few, 0, electrons)
    few &= electrons > 0
    if few.any():
        level[few] += rng.poisson(electrons[few])
    return level
