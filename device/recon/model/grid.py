"""Grids: the positions of sensor, field and PSF on the torus on which a frame is solved.

A measurement is a *cropped* convolution. On a periodic grid of the sensor's size, light that leaves at one side
re-enters at the opposite side. On a tight grid of (object + PSF)/2 + sensor/2 per axis (NUMERICS.md 1.2) no light that
reaches the sensor wraps round; the grid is smaller than zero padding to twice the sensor.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, isfinite

import numpy as np
from scipy.fft import next_fast_len

from device.values import Image, Psf

Pair = tuple[int, int]


@dataclass(frozen=True)
class Grid:
    """Torus of samples, of which a window is the frame of the sensor.

    Attributes
    ----------
    n
        n x n sensor pixels are one sample.
    sensor
        (rows, cols) of the sensor in pixels.
    shape
        (rows, cols) of the torus in samples.
    window
        (rows, cols) of the window in samples.
    at
        First sample (row, col) of the window on the torus.
    first_px
        First pixel (row, col) of the window on the sensor.
    radius_samples
        Radius of the field around `centre`; infinite if unknown.
    """

    n: int
    sensor: Pair
    shape: Pair
    window: Pair
    at: Pair
    first_px: Pair
    radius_samples: float

    @classmethod
    def periodic(cls, sensor: Pair, n: int, field_radius_px: float) -> "Grid":
        """Return the grid whose torus is the sensor itself, without a margin.

        Light that leaves at one side re-enters at the opposite side, as in the paper.

        Parameters
        ----------
        sensor
            (rows, cols) of the sensor in pixels.
        n
            n x n pixels become one sample.
        field_radius_px
            Radius of the lit field; infinite if unknown.

        Returns
        -------
        Grid
            Grid of one sample per n x n pixels.
        """
        shape = (sensor[0] // n, sensor[1] // n)
        return cls(n, sensor, shape, shape, (0, 0), (0, 0), field_radius_px / n)

    @classmethod
    def tight(cls, sensor: Pair, n: int, field_radius_px: float, psf_radius_px: float) -> "Grid":
        """Return the smallest grid with a fast FFT size on which no light that reaches the sensor wraps round.

        With a known field, sensor pixels beyond the blurred field are left out. Without one, the object extends
        as far as light can reach the sensor.

        Parameters
        ----------
        sensor
            (rows, cols) of the sensor in pixels.
        n
            n x n pixels become one sample.
        field_radius_px
            Radius of the lit field; infinite if unknown.
        psf_radius_px
            Radius of the PSF's support.

        Returns
        -------
        Grid
            Grid with a margin.
        """
        shape = []
        window = []
        for size in sensor:
            half = size // n / 2
            psf = psf_radius_px / n
            object_samples = (field_radius_px + 3) / n if isfinite(field_radius_px) else half + psf
            blocks = 8 if isfinite(field_radius_px) else 2  # shading is fitted on blocks of 4 x 4
            samples = _fast(ceil(object_samples + psf + min(half, object_samples + psf)) + 2, blocks)
            shape.append(samples)
            window.append(min(samples, size // n))
        at = [(g - w) // 2 for g, w in zip(shape, window, strict=True)]
        first_px = [(size - w * n) // 2 for size, w in zip(sensor, window, strict=True)]
        return cls(n, sensor, _pair(shape), _pair(window), _pair(at), _pair(first_px), field_radius_px / n)

    @property
    def size(self) -> int:
        """Number of samples of the torus."""
        return self.shape[0] * self.shape[1]

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices of the window on the torus."""
        return (
            slice(self.at[0], self.at[0] + self.window[0]),
            slice(self.at[1], self.at[1] + self.window[1]),
        )

    def clear_outside(self, image: Image) -> None:
        """Set an image on the torus to zero outside the window, in place.

        Parameters
        ----------
        image
            Float32 of `shape`.
        """
        rows, cols = self.slices
        image[: rows.start], image[rows.stop :] = 0, 0
        image[rows, : cols.start], image[rows, cols.stop :] = 0, 0

    @property
    def offset_px(self) -> Pair:
        """Pixels to add to a sensor position so that multiples of n are the borders of the torus' samples."""
        return self.at[0] * self.n - self.first_px[0], self.at[1] * self.n - self.first_px[1]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the sensor (row, col) in samples of the torus."""
        rows, cols = (
            ((size - 1) / 2 + offset - (self.n - 1) / 2) / self.n
            for size, offset in zip(self.sensor, self.offset_px, strict=True)
        )
        return rows, cols

    @property
    def shown(self) -> tuple[slice, slice]:
        """Slices of the displayed part of the torus: the box around the field, or the window without a known field."""
        if not isfinite(self.radius_samples):
            return self.slices
        spans = []
        for middle, at, window in zip(self.centre, self.at, self.window, strict=True):
            low = round(middle - self.radius_samples - 1)
            high = round(middle + self.radius_samples + 2)
            spans.append(slice(max(low, at, 0), max(min(high, at + window), max(low, at, 0) + 1)))
        return spans[0], spans[1]

    def field(self) -> Image:
        """Return the field as a mask on the torus.

        Returns
        -------
        Image
            Float32 of `shape`, 0 to 1; all ones if the field is unknown.
        """
        return disc(self.shape, self.centre, self.radius_samples)


def disc(shape: Pair, centre: tuple[float, float], radius_px: float) -> Image:
    """Return a disc with a soft edge of one pixel, (rows, cols) float32 in 0..1; all ones for an infinite radius."""
    if not isfinite(radius_px):
        return np.ones(shape, np.float32)
    rows = (np.arange(shape[0], dtype=np.float32) - np.float32(centre[0]))[:, None]
    cols = (np.arange(shape[1], dtype=np.float32) - np.float32(centre[1]))[None, :]
    rim: Image = np.clip(radius_px + 0.5 - np.hypot(rows, cols), 0, 1, dtype=np.float32)
    return rim


@lru_cache(maxsize=2)  # each holds its PSF
def support_radius_px(psf: Psf) -> float:
    """Return the radius of the PSF's support in pixels: 1.05 times the radius that holds 99.7 % of its sum, plus 2.

    Values beyond are noise of the calibration. The result is at most the distance of the image's corner.
    """
    rows = np.arange(psf.shape[0]) - psf.shape[0] // 2
    cols = np.arange(psf.shape[1]) - psf.shape[1] // 2
    radius = np.hypot(rows[:, None], cols[None]).astype(np.int64).ravel()
    within = np.cumsum(np.bincount(radius, psf.pixels.ravel().astype(np.float64)))
    reached = int(np.argmax(within >= 0.997 * within[-1]))
    return min(1.05 * reached + 2, float(radius.max() + 1))


def _fast(samples: int, multiple: int) -> int:
    """Return the smallest size with a fast FFT that is at least `samples` and divisible by `multiple`."""
    while (fast_size := int(next_fast_len(samples, real=True))) % multiple:
        samples = fast_size + 1
    return fast_size


def _pair(values: list[int]) -> Pair:
    return values[0], values[1]
