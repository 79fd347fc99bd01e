"""Pixels of one frame that do not hold the light of the eye: saturated, dead, warm, or hit by a reflex.

Calibrated dark frames and bad-pixel masks know the stable ones. This module finds the rest in the frame itself, from
what the optics cannot do: the PSF is the sharpest picture that the diffuser can make, so a pixel that differs from its
surroundings by more than the noise and the sharpest edge of the PSF holds something else than light.

* saturated pixels, and SATURATED_REACH_PX around saturated areas, where the clipped noise is biased;
* values below the black level that no noise explains;
* single outliers (warm, blinking, cosmic ray): off the median of a ring around them by more than NOISE_SD standard
  deviations plus the PSF's own sharpness times the ring's range;
* gaps without light (dead columns, rows, areas) behind a sharp edge.

A frame without a suspect costs one pass over its pixels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon import kernels
from device.recon.kernels import Pixels
from device.values import Calibration, Image, Mask, Psf

NOISE_SD = 6.0  # 2 million pixels of Gaussian noise hold one beyond this in 250 frames
SATURATED_REACH_PX = 3
AREA_NEIGHBOURS = 4  # of 8: saturated pixels with as many saturated neighbours are an area, not hot pixels
MOST_OUTLIERS = 0.05  # share of pixels; more is the structure of the frame, and none of them is called a defect
NARROW_PX = 25  # dead columns and rows up to this width are told by their brighter surroundings alone
SHADOW = 0.1  # of the light around it: a narrow gap is darker
EDGE_SHARE = 0.5  # of the border of a dark area that must be sharp
LEAST_EDGE_PX = 12  # of sharp border in a frame, for a search of dark areas
PASSES = 3  # an outlier hides its neighbour until it is left out
SAMPLES, LEVELS = 20_000, 6
LINE = np.float32(1.25)  # variance of a pixel minus the mean of four, in units of a pixel's variance
QUANTISATION_DN2 = 1 / 12


@dataclass(frozen=True)
class PixelNoise:
    """The variance of a pixel in DN^2: `per_dn` times its light above dark in DN, plus `floor_dn2`."""

    per_dn: float
    floor_dn2: float

    @classmethod
    def measured(cls, counts: Pixels, dark: Image) -> "PixelNoise":
        """The noise of a frame (rows, cols), from what a scatter of pixels differs by from their four neighbours.

        A line is fitted through the trimmed variances of LEVELS groups of equal brightness, so the fine structure that
        most pixels have counts as noise.
        """
        rows, cols = counts.shape
        if min(rows, cols) < 3:
            return cls(0.0, float("inf"))
        stride = max(1, (rows - 2) * (cols - 2) // SAMPLES) | 1
        place = np.arange(0, (rows - 2) * (cols - 2), stride)
        i, j = 1 + place // (cols - 2), 1 + place % (cols - 2)
        light = [_light_at(counts, dark, i + a, j + b) for a, b in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))]
        mean = (light[1] + light[2] + light[3] + light[4]) / 4
        off = light[0] - mean
        known = np.isfinite(off)
        mean, off = mean[known], off[known]
        order = np.argsort(mean)
        groups = [group for group in np.array_split(order, LEVELS) if group.size]
        level = np.array([max(float(np.median(mean[group])), 0.0) for group in groups])
        variance = np.array([_trimmed_variance(off[group]) for group in groups]) / float(LINE)
        variance = np.maximum(variance, QUANTISATION_DN2 if counts.dtype.kind == "u" else 0.0)
        return cls(*_line(level, variance))


def _light_at(counts: Pixels, dark: Image, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(counts[i, j] - dark[i % len(dark), j], np.float64)


def _trimmed_variance(off: NDArray[np.float64]) -> float:
    """The variance of normal deviations around 0, from the smaller nine tenths of them."""
    squares = np.sort(off**2)[: max(1, int(0.9 * off.size))]
    return float(squares.mean()) / 0.623  # of a unit normal within its 90 % interval


def _line(level: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[float, float]:
    """Slope and offset, neither negative, of variance over level; the offset is at most the darkest group's."""
    if not level.size:
        return 0.0, float("inf")
    floor = float(variance[0])
    slope = float(np.polyfit(level, variance, 1)[0]) if np.ptp(level) > 0 else 0.0
    slope = max(slope, 0.0)
    return slope, max(floor - slope * float(level[0]), 0.1 * floor)


class DefectFinder:
    """The search for defective pixels, planned for one calibration: its black level, white level and PSF."""

    def __init__(self, calibration: Calibration, shape: tuple[int, int], index: int = 0) -> None:
        sensor = calibration.sensor
        self._white_dn = sensor.white_dn
        self._dark: Image = np.full((1, shape[1]), sensor.black_dn, np.float32)
        if calibration.dark_dn is not None and calibration.dark_dn.shape == shape:
            self._dark = np.nan_to_num(calibration.dark_dn).astype(np.float32)
        self._bad: Mask = np.zeros(shape, np.bool_)
        if calibration.bad is not None and calibration.bad.shape == shape:
            self._bad = calibration.bad
        self._ranges = ring_ranges(calibration.psfs[index])
        self._suspect: Mask = np.zeros(shape, np.bool_)

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> Mask | None:
        """The defective pixels of a frame (rows, cols), uint16 or float32; None where there are none.

        `dark` is this shot's own dark frame. Pixels that the calibration marks are not searched.
        """
        offset = self._dark if dark is None else np.asarray(dark, np.float32)
        noise = PixelNoise.measured(counts, offset)
        limit = NOISE_SD**2 * float(LINE)
        least_dn = self._least_dn(offset, noise)
        found = kernels.mark_suspects(
            counts, offset, limit * noise.per_dn, limit * noise.floor_dn2, self._white_dn, least_dn, self._suspect
        )
        if not found:
            return None
        places = np.flatnonzero(self._suspect)
        values = counts.ravel()[places]
        light = _light_at(counts, offset, *np.divmod(places, counts.shape[1]))
        dark_dn = NOISE_SD * noise.floor_dn2**0.5
        saturated, low = values >= self._white_dn, light < least_dn
        defective = np.zeros(counts.shape, np.bool_)
        if saturated.any() or low.any():
            defective = around_areas(counts >= self._white_dn)
            defective.ravel()[places[low]] = True
        self._add_outliers(counts, offset, noise, places, defective)
        if np.count_nonzero(light <= dark_dn) >= LEAST_EDGE_PX:
            defective |= self._gaps(np.where(defective, np.float32(0), counts - offset), dark_dn)
        return defective if defective.any() else None

    def _least_dn(self, offset: Image, noise: PixelNoise) -> float:
        """The lowest value above dark that a working pixel gives: half the black level below it."""
        black_dn = float(offset.mean(dtype=np.float64))
        margin_dn = NOISE_SD * noise.floor_dn2**0.5
        return -(0.5 * black_dn + margin_dn) if black_dn > 4 * margin_dn else -3e38

    def _add_outliers(
        self, counts: Pixels, offset: Image, noise: PixelNoise, places: NDArray[np.int64], defective: Mask
    ) -> None:
        """Mark the outliers among `places`, unless they are so many that they are the structure of the frame."""
        limit = NOISE_SD**2
        slope_dn, floor_dn2 = limit * noise.per_dn, limit * noise.floor_dn2
        outlying = np.zeros_like(defective)
        known = defective | self._bad
        for _ in range(PASSES):
            if not kernels.outliers(counts, offset, known, places, slope_dn, floor_dn2, self._ranges, outlying):
                break
            known |= outlying
        if outlying.sum() <= MOST_OUTLIERS * outlying.size:
            defective |= outlying

    def _gaps(self, light: Image, dark_dn: float) -> Mask:
        """Areas without light behind a sharp edge: what no blur by the PSF can leave dark.

        Narrow ones (NARROW_PX) are far darker than their surroundings; wider ones hold no light at all.
        """
        around = ndimage.grey_closing(light, (NARROW_PX, NARROW_PX))
        narrow = (light < np.maximum(SHADOW * around, dark_dn)) & (around > 4 * dark_dn)
        return _with_sharp_border(narrow, self._suspect) | _with_sharp_border(
            (light <= dark_dn) & ~narrow, self._suspect
        )


def _with_sharp_border(areas: Mask, sharp: Mask) -> Mask:
    """Those connected areas whose border is `sharp` over EDGE_SHARE of its length."""
    labels, count = ndimage.label(areas)
    border = areas & ~ndimage.binary_erosion(areas, border_value=1)
    length_px = np.bincount(labels[border], minlength=count + 1)
    sharp_px = np.bincount(labels[border & sharp], minlength=count + 1)
    kept = sharp_px >= np.maximum(EDGE_SHARE * length_px, 1)
    kept[0] = False
    return np.asarray(kept[labels])


def around_areas(saturated: Mask) -> Mask:
    """Saturated areas and the pixels within SATURATED_REACH_PX of them; single hot pixels are not an area."""
    if not saturated.any():
        return saturated
    neighbours = ndimage.convolve(saturated.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant")
    areas = saturated & (neighbours > AREA_NEIGHBOURS)
    size = 2 * SATURATED_REACH_PX + 1
    return np.asarray(ndimage.maximum_filter(areas, size) | saturated)


def ring_ranges(psf: Psf) -> tuple[float, float]:
    """How far the PSF itself goes beyond the range of its rings, in units of that range, for both rings of `outliers`.

    The PSF is the frame of one point, the sharpest that there is; its own noise is taken off.
    """
    pixels = psf.pixels
    if min(pixels.shape) < 5:
        return float("inf"), float("inf")
    nothing = np.zeros((1, pixels.shape[1]), np.float32)
    noise = PixelNoise.measured(pixels, nothing)
    return kernels.ring_excess(
        pixels, 0.1 * float(pixels.max()), NOISE_SD**2 * noise.per_dn, NOISE_SD**2 * noise.floor_dn2
    )
