"""What the point source says: the PSF, merged from several exposures: its peaks are whole, and its tails bright."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import hypot

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import median_filter
from scipy.special import j1

from device.calibration.darks import Darks
from device.calibration.flats import Flats, straight
from device.calibration.moments import Moments
from device.errors import CalibrationRefused
from device.values import Frame, Image, Mask, Psf

BORDER = 1 / 16  # of the smaller side, where no light of the point should arrive
FULL = 0.95  # of the converter: what is brighter is cut
LEAST_PEAK = 0.2  # of the converter, in the shortest exposure: below it the tails drown
MOST_MOVED_PX = 0.5  # between two frames
MOST_PEDESTAL = 0.005  # of the mass (optics.md 5.4, item 6)
BRIGHT = 0.1  # of the peak: what a centroid is taken of
LEAST_OTF = 0.1  # of the disc: below it, noise would be made larger rather than the point smaller


@dataclass
class Steady:
    """Frames on their way into a mean: notes where the point is in each of them."""

    dark_dn: Image
    places: list[tuple[float, float]] = field(default_factory=list)

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The same frames; CalibrationRefused once the point has moved by half a pixel."""
        for frame in frames:
            if frame.counts.shape == self.dark_dn.shape:  # if not, whoever takes the frame in says so
                self._note(frame)
            yield frame

    def _note(self, frame: Frame) -> None:
        self.places.append(centroid_px(frame.counts - self.dark_dn))
        first, last = self.places[0], self.places[-1]
        if (moved_px := hypot(last[0] - first[0], last[1] - first[1])) > MOST_MOVED_PX:
            raise CalibrationRefused(
                f"the point source has moved by {moved_px:.1f} pixels by frame {frame.number}",
                "Fix source and head to one table, let them rest, then start again.",
            )


@dataclass(frozen=True)
class Point:
    """A measured PSF, and what is known of its faults.

    `light` (rows, cols) is the PSF's pixels, sum 1, centre in the middle; `off_px` (rows, cols) is how far the point
    was from the sensor's middle; `floor` the noise of a pixel over the peak, `removed` the pedestal taken away,
    `residual` what may be left: shares of the PSF's mass.
    """

    light: Image
    off_px: tuple[int, int]
    floor: float
    removed: float
    residual: float

    @property
    def psf(self) -> Psf:
        """As the calibration holds it."""
        return Psf(self.light, name="point source")


def measured_point(exposures: Sequence[Moments], darks: Darks, flats: Flats, disc_px: float = 0.0) -> Point:
    """From the point source at bracketed exposures to the PSF, float32 (rows, cols), sum 1, centre in the middle.

    `disc_px` is the diameter of the source's own image on the sensor. Centred by whole pixels: nothing is resampled.
    optics.md 2.1 (disc), 5.4 items 5, 6 and 12 (shift, pedestal, noise); paper, section "Methods".
    """
    bad = darks.hot | flats.dead
    refuse_level(min(exposures, key=lambda one: one.exposure_s), darks, flats)
    light = mended(merged(exposures, darks, flats) / flats.response, bad)
    light, pedestal, residual, floor = without_pedestal(light, bad)
    if disc_px > 0:
        light = without_disc(light, disc_px)
    middle = light.shape[0] // 2, light.shape[1] // 2
    place = centroid_px(light)
    off_px = round(place[0]) - middle[0], round(place[1]) - middle[1]
    return Point(Psf(moved(light, off_px)).pixels, off_px, floor, pedestal, residual)


def merged(exposures: Sequence[Moments], darks: Darks, flats: Flats) -> Image:
    """DN per second: all signal over all time of the exposures in which a pixel was never full; (rows, cols).

    The weights are the times, as shot noise wants them. A pixel that is full in all of them keeps the shortest.
    """
    signal, time_s = (np.zeros(darks.map_dn.shape, np.float32) for _ in range(2))
    for one in sorted(exposures, key=lambda one: one.exposure_s):
        usable = (one.highest < FULL * flats.white_dn) | (time_s == 0)
        lasting_s = np.float32(one.count * one.exposure_s)
        signal += usable * straight(one.mean_dn - darks.at(one.exposure_s), flats.bend_per_dn) * np.float32(one.count)
        time_s += usable * lasting_s
    return signal / time_s


def mended(light: Image, bad: Mask) -> Image:
    """Bad pixels become the median of the good ones around them."""
    if not bad.any():
        return light
    filled = np.where(bad, np.float32(np.median(light)), light)
    for _ in range(2):  # neighbours in bad company first get a guess
        filled = np.where(bad, median_filter(filled, 3), filled)
    return filled


def border(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """The four sides of a frame, where no light of the point should be."""
    wide = max(2, round(BORDER * min(shape)))
    every = slice(None)
    return [(slice(wide), every), (slice(-wide, None), every), (every, slice(wide)), (every, slice(-wide, None))]


def without_pedestal(light: Image, bad: Mask) -> tuple[Image, float, float, float]:
    """The light less the mean of its border; pedestal and what may be left of it over the mass; noise over the peak.

    What may be left: the side that differs most from the mean of all. Refuses a caustic that reaches the border.
    """
    good = ~bad
    sides = [light[side][good[side]].astype(np.float64) for side in border(light.shape)]
    level = float(np.concatenate(sides).mean())
    cleared = light - np.float32(level)
    mass = float(cleared.sum(dtype=np.float64))
    residual = max(abs(float(side.mean()) - level) for side in sides) * light.size / mass
    if mass <= 0 or residual > MOST_PEDESTAL:
        raise CalibrationRefused(
            f"the border of the frame is uneven by {residual:.2%} of the point's light (at most {MOST_PEDESTAL:.1%})",
            "Put the point on the axis and shade it: its light or the room's reaches the border.",
        )
    floor = float(np.concatenate(sides).std()) / float(cleared.max())
    return cleared, level * light.size / mass, residual, floor


def without_disc(light: Image, disc_px: float) -> Image:
    """As a point would have shown it: divided by the disc's 2 J1(x)/x below its first null, as far as it bears it.

    Beyond the null nothing is left: what a disc has hidden there cannot be found again. optics.md 2.1.
    """
    rows, cols = light.shape
    radius = np.hypot(fft.fftfreq(rows)[:, None], fft.rfftfreq(cols))
    x = np.maximum(np.pi * disc_px * radius, 1e-6)
    otf = np.where(x < 3.8317, 2 * j1(x) / x, 0.0)
    inverse: NDArray[np.float64] = otf * (1 + LEAST_OTF**2) / (otf**2 + LEAST_OTF**2)
    sharp: Image = fft.irfft2(fft.rfft2(light) * inverse.astype(np.float32), light.shape)
    return sharp.astype(np.float32)


def centroid_px(light: Image) -> tuple[float, float]:
    """The middle (row, col) of what is brighter than a tenth of the peak; a single hot pixel is not a peak."""
    bright = np.clip(light, 0, np.percentile(light, 99.5))
    bright -= np.float32(BRIGHT) * bright.max()
    np.maximum(bright, 0, out=bright)
    total = max(float(bright.sum(dtype=np.float64)), 1e-30)
    rows, cols = (np.arange(size) for size in light.shape)
    return (
        float(bright.sum(1, dtype=np.float64) @ rows) / total,
        float(bright.sum(0, dtype=np.float64) @ cols) / total,
    )


def moved(light: Image, off_px: tuple[int, int]) -> Image:
    """Brought back by whole pixels; what comes in from beyond the edge is dark."""
    out = np.zeros_like(light)
    into, of = [], []
    for size, by in zip(light.shape, off_px, strict=True):
        into.append(slice(max(-by, 0), size - max(by, 0)))
        of.append(slice(max(by, 0), size - max(-by, 0)))
    out[tuple(into)] = light[tuple(of)]
    return out


def refuse_level(shortest: Moments, darks: Darks, flats: Flats) -> None:
    """A point source that is too dark or too bright in its shortest exposure."""
    bad = darks.hot | flats.dead
    signal = np.where(bad, 0, shortest.mean_dn - darks.at(shortest.exposure_s))
    peak_dn, white_dn = float(signal.max()), flats.white_dn - darks.black_dn
    if peak_dn < LEAST_PEAK * white_dn:
        raise CalibrationRefused(
            f"the point source is too dark: {peak_dn:.0f} DN at {shortest.exposure_s:.3g} s (at least "
            f"{LEAST_PEAK * white_dn:.0f})",
            "Take the cap off and put a brighter point source on the axis.",
        )
    if (full := int(((shortest.highest >= FULL * flats.white_dn) & ~bad).sum())) > 0:
        raise CalibrationRefused(
            f"the point source is saturated: {full} pixels are full at {shortest.exposure_s:.3g} s",
            "Dim the point source.",
        )
