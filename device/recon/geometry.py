"""Where the sensor, the field and the PSF lie on one another: the grid on which a frame is solved.

A measurement is a *cropped* convolution. On a periodic grid of the sensor's own size what leaves on one side comes back
on the other; on a tight grid of (object + PSF)/2 + sensor/2 per axis (optics.md 5.1) nothing that reaches the sensor
does, and it is smaller than zero padding to twice the sensor.
"""

from dataclasses import dataclass
from math import ceil, isfinite

import numpy as np
from scipy.fft import next_fast_len

from device.values import Image, Psf

Pair = tuple[int, int]


@dataclass(frozen=True)
class Grid:
    """A torus of `shape` samples, each n x n sensor pixels; `window` samples of it are what the sensor saw.

    The window begins at sample `at` of the grid and at pixel `first_px` of the (rows, cols) `sensor`.
    `radius_samples` is the field's, around `centre`; infinite where it is not known.
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
        """The sensor itself as a torus, as the paper does."""
        shape = (sensor[0] // n, sensor[1] // n)
        return cls(n, sensor, shape, shape, (0, 0), (0, 0), field_radius_px / n)

    @classmethod
    def tight(cls, sensor: Pair, n: int, field_radius_px: float, psf_radius_px: float) -> "Grid":
        """The smallest good torus on which no light that reaches the sensor wraps round.

        With a known field the sensor beyond the field's blurred image is left out: it saw nothing. Without one the
        object may be anywhere from which light can reach the sensor.
        """
        shape, window = [], []
        for size in sensor:
            half, psf = size // n / 2, psf_radius_px / n
            thing = (field_radius_px + 3) / n if isfinite(field_radius_px) else half + psf
            blocks = 8 if isfinite(field_radius_px) else 2  # shading is fitted on blocks of four
            samples = _fast(ceil(thing + psf + min(half, thing + psf)) + 2, blocks)
            shape.append(samples)
            window.append(min(samples, size // n))
        at = [(g - w) // 2 for g, w in zip(shape, window, strict=True)]
        first_px = [(size - w * n) // 2 for size, w in zip(sensor, window, strict=True)]
        return cls(n, sensor, _pair(shape), _pair(window), _pair(at), _pair(first_px), field_radius_px / n)

    @property
    def size(self) -> int:
        """Samples of the torus."""
        return self.shape[0] * self.shape[1]

    @property
    def slices(self) -> tuple[slice, slice]:
        """The window on the torus."""
        return (
            slice(self.at[0], self.at[0] + self.window[0]),
            slice(self.at[1], self.at[1] + self.window[1]),
        )

    def clear_outside(self, image: Image) -> None:
        """Zero what lies outside the window of an image on the torus; the window itself stays."""
        rows, cols = self.slices
        image[: rows.start], image[rows.stop :] = 0, 0
        image[rows, : cols.start], image[rows, cols.stop :] = 0, 0

    @property
    def offset_px(self) -> Pair:
        """What to add to a sensor pixel's place so that n of them make one sample of the torus."""
        return self.at[0] * self.n - self.first_px[0], self.at[1] * self.n - self.first_px[1]

    @property
    def centre(self) -> tuple[float, float]:
        """The middle of the sensor, in samples of the torus."""
        rows, cols = (
            ((size - 1) / 2 + offset - (self.n - 1) / 2) / self.n
            for size, offset in zip(self.sensor, self.offset_px, strict=True)
        )
        return rows, cols

    @property
    def shown(self) -> tuple[slice, slice]:
        """The part of the torus that people look at: the field, or the window where no field is known."""
        if not isfinite(self.radius_samples):
            return self.slices
        spans = []
        for middle, at, window in zip(self.centre, self.at, self.window, strict=True):
            low, high = round(middle - self.radius_samples - 1), round(middle + self.radius_samples + 2)
            spans.append(slice(max(low, at, 0), max(min(high, at + window), max(low, at, 0) + 1)))
        return spans[0], spans[1]

    def field(self) -> Image:
        """The field as a mask on the torus, float32, 0 to 1."""
        return disc(self.shape, self.centre, self.radius_samples)


def disc(shape: Pair, centre: tuple[float, float], radius_px: float) -> Image:
    """A disc with a one-pixel soft rim, (rows, cols) float32 in 0..1; an infinite radius fills everything."""
    if not isfinite(radius_px):
        return np.ones(shape, np.float32)
    rows = (np.arange(shape[0], dtype=np.float32) - np.float32(centre[0]))[:, None]
    cols = (np.arange(shape[1], dtype=np.float32) - np.float32(centre[1]))[None, :]
    rim: Image = np.clip(radius_px + 0.5 - np.hypot(rows, cols), 0, 1, dtype=np.float32)
    return rim


def support_radius_px(psf: Psf) -> float:
    """How far from its centre a PSF carries light: 99.7 % of its energy within, and a twentieth more.

    What lies farther is the calibration's noise; at most the corner of the image.
    """
    rows = np.arange(psf.shape[0]) - psf.shape[0] // 2
    cols = np.arange(psf.shape[1]) - psf.shape[1] // 2
    radius = np.hypot(rows[:, None], cols[None]).astype(np.int64).ravel()
    within = np.cumsum(np.bincount(radius, psf.pixels.ravel().astype(np.float64)))
    reached = int(np.argmax(within >= 0.997 * within[-1]))
    return min(1.05 * reached + 2, float(radius.max() + 1))


def _fast(samples: int, multiple: int) -> int:
    """The next size that an FFT likes and that `multiple` divides: blocks of four samples still make an even torus."""
    while (good := int(next_fast_len(samples, real=True))) % multiple:
        samples = good + 1
    return good


def _pair(values: list[int]) -> Pair:
    return values[0], values[1]
