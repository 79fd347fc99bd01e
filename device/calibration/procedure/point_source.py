"""PSF from a point source at bracketed exposures, merged so that peaks are not clipped and tails have little noise."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import hypot

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import median_filter, uniform_filter
from scipy.special import j1

from device.calibration.procedure.darks import Darks
from device.calibration.procedure.flats import Flats, linearised
from device.calibration.procedure.moments import Moments
from device.errors import CalibrationRefused
from device.values import Frame, Image, Mask, Psf

BORDER = 1 / 16  # share of the smaller side; no light of the point should arrive there
SATURATED_SHARE = 0.95  # of the converter range; brighter pixels are clipped
MIN_PEAK = 0.2  # of the converter range, in the shortest exposure: below it noise hides the tails
MAX_MOVED_PX = 0.5  # from the first frame
MAX_PEDESTAL = 0.005  # of the PSF's sum (NUMERICS.md 3.5, item 6)
CENTROID_THRESHOLD = 0.1  # of the peak: threshold of the centroid
SPOT_THRESHOLD = 0.01  # of the brightest 3 x 3 pixels
FEW_PIXELS = 0.03  # of the brightest 3 x 3 pixels: a caustic's 99.5th percentile has 0.22 to 0.83, spots' 0.007
MIN_OTF = 0.1  # OTF of the disc: below it deconvolution would amplify noise, not sharpen


@dataclass
class MotionCheck:
    """Motion check of the point source in its frames, less the dark frame, by their place against the first one."""

    dark_dn: Image
    first: list[Image] = field(default_factory=list)

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames unchanged; CalibrationRefused once the centroid is over 0.5 pixels from its first place."""
        for frame in frames:
            if frame.counts.shape == self.dark_dn.shape:  # other shapes are refused by Moments.add
                self._note(frame)
            yield frame

    def _note(self, frame: Frame) -> None:
        light = frame.counts - self.dark_dn
        self.first = self.first or [light]
        if (moved_px := hypot(*_shift_px(self.first[0], light))) > MAX_MOVED_PX:
            raise CalibrationRefused(
                f"the point source has moved by {moved_px:.1f} pixels by frame {frame.number}",
                "Fix source and head to one table, let them rest, then start again.",
            )


@dataclass(frozen=True)
class PointSource:
    """Measured PSF with its error figures.

    `light` (rows, cols) is the PSF, sum 1, centred; `off_px` (rows, cols) is the offset of the point from the sensor
    centre; `floor` is the noise of a pixel over the peak, `removed` the subtracted pedestal, `residual` a bound on its
    remainder; both as shares of the PSF's sum.
    """

    light: Image
    off_px: tuple[int, int]
    floor: float
    removed: float
    residual: float

    @property
    def psf(self) -> Psf:
        """Return the PSF as the calibration stores it."""
        return Psf(self.light, name="point source")


def measure_point_source(exposures: Sequence[Moments], darks: Darks, flats: Flats, disc_px: float = 0.0) -> PointSource:
    """Return the point-source measurement from bracketed exposures; its PSF is float32 (rows, cols), sum 1, centred.

    `disc_px` is the diameter of the source's image on the sensor. The PSF is centred by whole pixels, not resampled.
    OPTICS.md 2.5 (disc); NUMERICS.md 3.5, items 5, 6 and 12 (shift, pedestal, noise); paper, section "Methods".
    CalibrationRefused if the source is too dark or too bright, or its light reaches the border.
    """
    bad = darks.hot | flats.dead
    refuse_level(min(exposures, key=lambda exposure: exposure.exposure_s), darks, flats)
    light = replace_bad_pixels(merge_exposures(exposures, darks, flats) / flats.response, bad)
    light, pedestal, residual, floor = subtract_pedestal(light, bad)
    if disc_px > 0:
        light = deconvolve_disc(light, disc_px)
    middle = light.shape[0] // 2, light.shape[1] // 2
    place = centroid_px(light)
    off_px = round(place[0]) - middle[0], round(place[1]) - middle[1]
    return PointSource(Psf(shift_by_pixels(light, off_px)).pixels, off_px, floor, pedestal, residual)


def merge_exposures(exposures: Sequence[Moments], darks: Darks, flats: Flats) -> Image:
    """Return the light, DN/s, (rows, cols): total linearised signal over total time of the unsaturated exposures.

    Weights are the exposure times, optimal for shot noise. A pixel saturated in all exposures keeps the shortest one.
    """
    signal, time_s = (np.zeros(darks.map_dn.shape, np.float32) for _ in range(2))
    for exposure in sorted(exposures, key=lambda exposure: exposure.exposure_s):
        usable = (exposure.highest < SATURATED_SHARE * flats.white_dn) | (time_s == 0)
        lasting_s = np.float32(exposure.count * exposure.exposure_s)
        signal += (
            usable
            * linearised(exposure.mean_dn - darks.at(exposure.exposure_s), flats.bend_per_dn)
            * np.float32(exposure.count)
        )
        time_s += usable * lasting_s
    return signal / time_s


def replace_bad_pixels(light: Image, bad: Mask) -> Image:
    """Return the image with each bad pixel replaced by the median of its 3 x 3 neighbourhood."""
    if not bad.any():
        return light
    filled = np.where(bad, np.float32(np.median(light)), light)
    for _ in range(2):  # twice: clusters of bad pixels start from a first estimate
        filled = np.where(bad, median_filter(filled, 3), filled)
    return filled


def border_strips(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Return the slices of the four border strips of a frame, where no light of the point should arrive."""
    wide = max(2, round(BORDER * min(shape)))
    every = slice(None)
    return [(slice(wide), every), (slice(-wide, None), every), (every, slice(wide)), (every, slice(-wide, None))]


def subtract_pedestal(light: Image, bad: Mask) -> tuple[Image, float, float, float]:
    """Return the light without its border mean; pedestal and residual over the light's sum; border noise over the peak.

    The residual is the largest deviation of one side from the mean of all. Raises CalibrationRefused if light of the
    caustic reaches the border.
    """
    good = ~bad
    sides = [light[side][good[side]].astype(np.float64) for side in border_strips(light.shape)]
    level = float(np.concatenate(sides).mean())
    cleared = light - np.float32(level)
    mass = float(cleared.sum(dtype=np.float64))
    residual = max(abs(float(side.mean()) - level) for side in sides) * light.size / mass
    if mass <= 0 or residual > MAX_PEDESTAL:
        raise CalibrationRefused(
            f"the border of the frame is uneven by {residual:.2%} of the point's light (at most {MAX_PEDESTAL:.1%})",
            "Tilt the source until its disc is in the middle of the frame, and shade it: light reaches the border.",
        )
    floor = float(np.concatenate(sides).std()) / float(cleared.max())
    return cleared, level * light.size / mass, residual, floor


def deconvolve_disc(light: Image, disc_px: float) -> Image:
    """Return the image without the blur of the source's disc (diameter `disc_px`): regularised division by its OTF.

    OTF: 2 J1(x)/x; frequencies beyond its first null are set to zero, because the disc removed them. OPTICS.md 2.5.
    """
    rows, cols = light.shape
    radius = np.hypot(fft.fftfreq(rows)[:, None], fft.rfftfreq(cols))
    x = np.maximum(np.pi * disc_px * radius, 1e-6)
    otf = np.where(x < 3.8317, 2 * j1(x) / x, 0.0)
    inverse: NDArray[np.float64] = otf * (1 + MIN_OTF**2) / (otf**2 + MIN_OTF**2)
    sharp: Image = fft.irfft2(fft.rfft2(light) * inverse.astype(np.float32), light.shape)
    return sharp.astype(np.float32)


def _shift_px(first: Image, light: Image) -> tuple[float, float]:
    """Return the shift (rows, cols) of the light from the first frame on.

    By the centroids, but of spots, whose centroid moves by 0.15 pixels (rms) with the shot noise of each spot's light,
    by the maximum of the correlation.
    """
    if not _is_of_spots(first):
        (row, col), (last_row, last_col) = centroid_px(first), centroid_px(light)
        return last_row - row, last_col - col
    alike = fft.irfft2(fft.rfft2(light) * np.conj(fft.rfft2(first)), first.shape)
    row, col = (int(place) for place in np.unravel_index(int(alike.argmax()), alike.shape))
    return _vertex(alike[:, col], row), _vertex(alike[row], col)


def _vertex(periodic: Image, place: int) -> float:
    """Return the vertex of the parabola through a maximum and its neighbours, from -half the length to half of it."""
    size = len(periodic)
    before, middle, after = (float(periodic[(place + k) % size]) for k in (-1, 0, 1))
    return (place + size // 2) % size - size // 2 + (before - after) / (2 * (before - 2 * middle + after))


def _is_of_spots(light: Image) -> bool:
    """Return whether the light fills so few pixels that the 99.5th percentile does not show it."""
    return bool(np.percentile(light, 99.5) < FEW_PIXELS * uniform_filter(light, 3).max())


def centroid_px(light: Image) -> tuple[float, float]:
    """Return the centroid (row, col) of the light above a tenth of the peak; the peak is the 99.5th percentile.

    Of spots: of the light above a hundredth of the brightest 3 x 3 pixels.
    """
    if _is_of_spots(light):  # the light of a spot is in proportion to its cell, so that the middle is the iris's
        bright = light - np.float32(SPOT_THRESHOLD) * uniform_filter(light, 3).max()
    else:
        bright = np.clip(light, 0, np.percentile(light, 99.5))
        bright -= np.float32(CENTROID_THRESHOLD) * bright.max()
    np.maximum(bright, 0, out=bright)
    total = max(float(bright.sum(dtype=np.float64)), 1e-30)
    rows, cols = (np.arange(size) for size in light.shape)
    return (
        float(bright.sum(1, dtype=np.float64) @ rows) / total,
        float(bright.sum(0, dtype=np.float64) @ cols) / total,
    )


def shift_by_pixels(light: Image, off_px: tuple[int, int]) -> Image:
    """Return the image moved by -`off_px` (rows, cols), whole pixels; pixels from beyond the edge are zero."""
    out = np.zeros_like(light)
    into = []
    of = []
    for size, by in zip(light.shape, off_px, strict=True):
        into.append(slice(max(-by, 0), size - max(by, 0)))
        of.append(slice(max(by, 0), size - max(-by, 0)))
    out[tuple(into)] = light[tuple(of)]
    return out


def refuse_level(shortest: Moments, darks: Darks, flats: Flats) -> None:
    """Raise CalibrationRefused if the point source is too dark or too bright in the given (shortest) exposure."""
    bad = darks.hot | flats.dead
    signal = np.where(bad, 0, shortest.mean_dn - darks.at(shortest.exposure_s))
    peak_dn = float(signal.max())
    white_dn = flats.white_dn - darks.black_dn
    if peak_dn < MIN_PEAK * white_dn:
        raise CalibrationRefused(
            f"the point source is too dark: {peak_dn:.0f} DN at {shortest.exposure_s:.3g} s (at least "
            f"{MIN_PEAK * white_dn:.0f})",
            "Take the cap off and put a brighter point source on the axis.",
        )
    if (full := int(((shortest.highest >= SATURATED_SHARE * flats.white_dn) & ~bad).sum())) > 0:
        raise CalibrationRefused(
            f"the point source is saturated: {full} pixels are full at {shortest.exposure_s:.3g} s",
            "Dim the point source.",
        )
