"""Sensor model: electrons to counts with shot noise, full well, read noise, gain, black level and converter.

OPTICS.md 3.8: DN = round(black + min(s (1 + k s / b), well) / gain), clipped to 0 to white, with s = Poisson(e) + read
noise + offset, k the nonlinearity, and b the charge to which it refers (`bends_at_e`).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from device.config.head_file import CameraSpec
from device.values import Counts, Image

# Above this mean a Gaussian of the same mean and variance stands for the Poisson law. Their distribution functions then
# differ by at most 0.3041 / sqrt(mean) (Shevtsova 2014, Berry-Esseen for Poisson) = 0.03; below it the draw is exact.
GAUSSIAN_FROM_E = 100.0
STRIP_ROWS = 64
UNCLIPPED_DN = 65535  # maximum of uint16


@dataclass(frozen=True)
class SensorModel:
    """Conversion of electrons to counts, in the units of a head's [camera] table.

    `offset_e` (rows, cols) is a fixed pattern; `nonlinearity` is the relative error of the response at `bends_at_e`
    electrons, from a quadratic term. `shot` is false for a sensor without shot noise.
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
        """Return the sensor of a head file's [camera] table, with shot noise, linear and without fixed pattern."""
        return cls(camera.gain_e_per_dn, camera.black_dn, camera.white_dn, camera.full_well_e, camera.read_noise_e)

    @classmethod
    def ideal(cls, camera: CameraSpec) -> "SensorModel":
        """Return the noise-free sensor with unlimited full well; counts are only rounded and clipped to 0..65535."""
        well_e = camera.full_well_e
        return cls(camera.gain_e_per_dn, camera.black_dn, UNCLIPPED_DN, float("inf"), 0.0, False, 0.0, well_e)

    def offset_by(self, pattern_e: Image) -> "SensorModel":
        """Return the sensor with an additional fixed pattern, electrons (rows, cols)."""
        return replace(self, offset_e=pattern_e if self.offset_e is None else self.offset_e + pattern_e)

    def crop_to_centre(self, shape: tuple[int, int]) -> "SensorModel":
        """Return the sensor with its fixed pattern cropped to the central (rows, cols) of `shape`."""
        if self.offset_e is None:
            return self
        rows, cols = (
            slice(have // 2 - n // 2, have // 2 - n // 2 + n)
            for have, n in zip(self.offset_e.shape, shape, strict=True)
        )
        return replace(self, offset_e=self.offset_e[rows, cols])

    def read(self, electrons: Image, seed: int | tuple[int, ...], into: Counts | None = None) -> Counts:
        """Return one noisy frame of the expected `electrons` (rows, cols): uint16, reproducible by `seed`.

        `into` is filled and returned if given. Each strip of 64 rows has its own random stream, so the frame does not
        depend on the number of threads.
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
        """Fill `rows` of `counts` with the noisy counts of one strip, drawn from `stream`."""
        rng = np.random.Generator(np.random.SFC64(stream))
        if self.shot:
            level = add_noise(electrons[rows], self.read_noise_e, rng)
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


def add_noise(electrons: Image, read_noise_e: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return electrons with shot noise and read noise, float32, for expected `electrons` >= 0.

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
