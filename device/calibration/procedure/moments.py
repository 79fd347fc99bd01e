"""Running mean and variance of frames, without storing the frames."""

from collections.abc import Iterable

import numpy as np

from device.errors import CalibrationRefused
from device.values import Counts, Frame, Image


class Moments:
    """Mean, variance and maximum of each pixel over the frames of one exposure, from exact integer sums.

    Refuses frames whose shape or exposure differs from `shape` and `exposure_s`, and frames with the lamp on.
    """

    def __init__(self, shape: tuple[int, int], exposure_s: float) -> None:
        self.shape = shape
        self.exposure_s = exposure_s
        self.count = 0
        self._sum = np.zeros(shape, np.int64)
        self._squares = np.zeros(shape, np.int64)
        self._wide = np.empty(shape, np.int64)
        self.highest: Counts = np.zeros(shape, np.uint16)

    def add(self, frame: Frame) -> None:
        """Add one frame; CalibrationRefused for another shape, another exposure (by 2 %), or the lamp on."""
        if frame.counts.shape != self.shape:
            raise CalibrationRefused(
                f"frame {frame.number} is {frame.counts.shape}, this head gives {self.shape}",
                "The camera is in another mode. Turn the device off and on, and start with the file of this head.",
            )
        if not np.isclose(frame.exposure_s, self.exposure_s, rtol=0.02):
            raise CalibrationRefused(
                f"frame {frame.number} was exposed for {frame.exposure_s:.4g} s instead of {self.exposure_s:.4g} s",
                "The camera does not do what it is told. Turn the device off and on.",
            )
        if frame.illumination is not None:
            raise CalibrationRefused(
                f"the lamp was on in frame {frame.number}: "
                f"{frame.illumination.colour} at {frame.illumination.level:.2g}",
                "Turn the lamp off: nothing is calibrated in its light.",
            )
        self._wide[...] = frame.counts
        self._sum += self._wide
        self._wide *= self._wide
        self._squares += self._wide
        np.maximum(self.highest, frame.counts, out=self.highest)
        self.count += 1

    @classmethod
    def over(cls, frames: Iterable[Frame], shape: tuple[int, int], exposure_s: float) -> "Moments":
        """Return the moments of all these frames; CalibrationRefused for a frame that `add` refuses."""
        moments = cls(shape, exposure_s)
        for frame in frames:
            moments.add(frame)
        return moments

    @property
    def mean_dn(self) -> Image:
        """Return the mean, (rows, cols), DN."""
        return (self._sum / self.count).astype(np.float32)

    @property
    def variance_dn2(self) -> Image:
        """Return the unbiased temporal variance of each pixel, (rows, cols), DN squared; needs two frames."""
        if self.count < 2:
            raise CalibrationRefused("a variance needs two frames", "Take more frames.")
        spread = self.count * self._squares - self._sum**2
        return (spread / (self.count * (self.count - 1))).astype(np.float32)
