"""Electrons that arrive become counts that are read: shot noise, full well, read noise, gain, black level, converter.

optics.md 3.9 without dark current and fixed pattern: DN = round(black + min(Poisson(e) + read, well) / gain).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.spec import CameraSpec
from device.values import Counts, Image

# Above this mean a Gaussian of the same mean and variance stands for the Poisson law. Their distribution functions then
# differ by at most 0.3041 / sqrt(mean) (Shevtsova 2014, Berry-Esseen for Poisson) = 0.03; below it the draw is exact.
GAUSSIAN_FROM_E = 100.0
STRIP_ROWS = 64


@dataclass(frozen=True)
class SensorModel:
    """What turns electrons into counts, in the units of a head's [camera] table."""

    gain_e_per_dn: float
    black_dn: float
    white_dn: int
    full_well_e: float
    read_noise_e: float

    @classmethod
    def of(cls, camera: CameraSpec) -> "SensorModel":
        """The sensor that a head's file describes."""
        return cls(camera.gain_e_per_dn, camera.black_dn, camera.white_dn, camera.full_well_e, camera.read_noise_e)

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
                pool.submit(self._read_strip, electrons[r : r + STRIP_ROWS], stream, counts[r : r + STRIP_ROWS])
                for r, stream in zip(starts, streams, strict=True)
            ]
            for strip in strips:
                strip.result()
        return counts

    def _read_strip(self, electrons: Image, stream: np.random.SeedSequence, into: Counts) -> None:
        level = noisy(electrons, self.read_noise_e, np.random.Generator(np.random.SFC64(stream)))
        np.minimum(level, np.float32(self.full_well_e), out=level)
        level *= np.float32(1 / self.gain_e_per_dn)
        level += np.float32(self.black_dn)
        np.rint(level, out=level)
        np.clip(level, 0, self.white_dn, out=level)
        np.copyto(into, level, casting="unsafe")


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
