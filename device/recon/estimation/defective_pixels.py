"""Detection of defective pixels in one frame: saturated, dead, warm, dark, or inside the halo of a reflex.

Calibrated dark frames and bad-pixel masks list the permanent defects. This module finds the others in the frame. The
PSF has the highest local contrast that the optics can pass. A pixel whose local contrast exceeds the PSF's by more than
the noise is not an image of light: it is a defect.

* saturated pixels, and the pixels around them whose noise the converter clips (CLIPPED_SD, CLIPPED_SHARE,
  SATURATED_REACH_PX);
* values below the black level by more than the noise and LOW_SHARE of that level;
* single outliers (warm, blinking, cosmic ray): off the median of a ring around them by more than NOISE_SD standard
  deviations plus `ring_ranges` of the PSF times the ring's range; none above MAX_OUTLIERS;
* gaps without light (dead columns, rows, areas) with a sharp border (NARROW_PX, SHADOW, EDGE, EDGE_SHARE);
* the halo of a reflex: light around a saturated area beyond the fitted smooth field (HALO, HALO_BEGINS, HALO_SD).

A frame without a candidate pixel costs one pass over its pixels.

`without_hot_pixels` applies the outlier test to the image of a PSF, which has no other PSF to be compared with.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from device.recon.estimation.shading import Shading
from device.recon.estimation.spots import on_sensor
from device.recon.model import kernels
from device.recon.model.compiled import read_only
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.forward_model import tight_model
from device.recon.model.kernels import Pixels, Places
from device.recon.model.preprocessing import Linear, Preprocessor, require_shape
from device.values import Calibration, Image, Mask, Psf

NOISE_SD = 6.0  # 2 million pixels of Gaussian noise hold one beyond this in 250 frames
SATURATED_REACH_PX = 3
CLIPPED_SD = 2.0  # of the noise below the white level, where the converter clips one value in forty
CLIPPED_SHARE = 0.1  # of the white level, at the most: a well of 400 electrons has noise of 0.05
AREA_NEIGHBOURS = 4  # of 8: saturated pixels with as many saturated neighbours are an area, not hot pixels
MAX_OUTLIERS = 0.05  # share of pixels of one kind; more are structure of the frame, and none is marked
NARROW_PX = 25  # dead columns and rows up to this width are found by comparison with their surroundings
LIT = 4.0  # in units of the largest value without light: the least light beside an edge
SHADOW = 0.1  # of the light around it: a narrow gap is darker
EDGE = 0.3  # of the light around it: the step at the border of a gap is larger
EDGE_SHARE = 0.5  # of the border of a dark area that must be sharp
MIN_EDGE_PX = 12  # of sharp border in a frame, for a search of dark areas
HALO = 0.01  # of the light of the fitted field: more is a reflex. Overexposed eyes have at most 0.003
HALO_BEGINS = 0.05  # of it in the first ring; an eye of 8 dpt with the stored PSF has up to 0.04
HALO_SD = 3.0  # standard errors of a ring's mean excess
HALO_MARGIN = 3  # samples beyond the last ring with an excess
HALO_REPETITIONS = 5  # the halo biases the first fit of the field
HALO_SAMPLES = 135  # of the shorter side of the sensor, on which halos are measured
MIN_AREA = 2  # samples of a saturated area that may have a halo
RANGE_SHARE = 0.999  # of the PSF's pixels; a frame is a mean of many PSFs, in which no single pixel of one stands out
PSF_NOISE_SD = 1.0  # subtracted from the PSF's ring excess; the measured noise includes the PSF's own fine lines
# Excess of a hot pixel of a PSF over its rings, in their ranges: recorded PSFs have up to 8 and 25, hot pixels hundreds
HOT_RANGES = (10.0, 30.0)
HOT_SHARE = 0.05  # of the PSF's brightest light (its quantile RANGE_SHARE): a dimmer excess does no harm
CORE_SHARE = 0.02  # of the light: a pixel with more is the focus of a sharp PSF, and not hot
SPREAD_SHARE = 0.05  # of a pixel's light, in its second darkest neighbour: spots of lenses 0.10 to 0.21, hot pixels 0
MAX_HOT_LIGHT = 0.5  # share of the light: candidates with more are the points of a sharp PSF
LOW_SHARE = 0.5  # of the black level: the lowest value of a working pixel is so far below it, plus the noise limit
BLACK_PER_LIMIT = 4  # least black level over the noise limit; with a lower one, values below black are not tested
FEW = 200  # candidates; with fewer the calibrated noise is kept
PASSES = 3  # an outlier masks its neighbour until it is left out
SAMPLES, LEVELS = 6_000, 6
LINE = np.float32(1.25)  # variance of a pixel minus the mean of four, in units of a pixel's variance
QUANTISATION_DN2 = 1 / 12


@dataclass(frozen=True)
class PixelNoise:
    """The variance of a pixel in DN^2: `per_dn` times its light above dark in DN, plus `floor_dn2`."""

    per_dn: float
    floor_dn2: float

    def at_least(self, other: "PixelNoise") -> "PixelNoise":
        """Return the larger `per_dn` with the larger `floor_dn2`: an upper bound of both models at every brightness.

        A frame that is mostly dark determines its shot noise poorly.
        """
        return PixelNoise(max(self.per_dn, other.per_dn), max(self.floor_dn2, other.floor_dn2))

    @classmethod
    def measured(cls, counts: Pixels, dark: Image, white_dn: float = float("inf")) -> "PixelNoise":
        """Estimate the noise of `counts` (rows, cols) from about SAMPLES pixels and their four neighbours.

        A line is fitted to the trimmed variances, in LEVELS groups of similar brightness, of a pixel minus the mean of
        its neighbours; fine structure that most pixels have counts as noise. `dark` is (rows, cols) or (1, cols) in DN.
        Pixels at `white_dn` are left out. With fewer than 3 rows or columns `floor_dn2` is infinite.
        """
        rows, cols = counts.shape
        if min(rows, cols) < 3:
            return cls(0.0, float("inf"))
        places = np.arange(0, (rows - 2) * (cols - 2), max(1, (rows - 2) * (cols - 2) // SAMPLES) | 1)
        mean = np.empty(places.size, np.float32)
        off = np.empty(places.size, np.float32)
        kernels.neighbours(counts, dark, places, mean, off)
        known = np.isfinite(off) & (counts[1 + places // (cols - 2), 1 + places % (cols - 2)] < white_dn)
        mean = mean[known].astype(np.float64)
        off = off[known].astype(np.float64)
        order = np.argsort(mean)
        groups = [group for group in np.array_split(order, LEVELS) if group.size]
        level = np.array([max(float(np.median(mean[group])), 0.0) for group in groups])
        variance = np.array([_trimmed_variance(off[group]) for group in groups]) / float(LINE)
        variance = np.maximum(variance, QUANTISATION_DN2 if counts.dtype.kind == "u" else 0.0)
        return cls(*_line(level, variance))


def _light_at(counts: Pixels, dark: Image, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(counts[i, j] - dark[i % len(dark), j], np.float64)


def _trimmed_variance(off: NDArray[np.float64]) -> float:
    """Return the variance of normal deviations around 0, estimated from the smaller nine tenths of them."""
    squares = np.sort(off**2)[: max(1, int(0.9 * off.size))]
    return float(squares.mean()) / 0.623  # of a unit normal within its 90 % interval


def _line(level: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[float, float]:
    """Return slope and offset of variance over level, both >= 0; the offset is 0.1 to 1 times the darkest group's."""
    if not level.size:
        return 0.0, float("inf")
    floor = float(variance[0])
    slope = float(np.polyfit(level, variance, 1)[0]) if np.ptp(level) > 0 else 0.0
    slope = max(slope, 0.0)
    return slope, max(floor - slope * float(level[0]), 0.1 * floor)


class DefectFinder:
    """Search for defective pixels in the frames of one calibration: its black level, white level, noise and PSF.

    `dark` is its dark frame, (rows, cols), or its black level, (1, cols), float32 DN.
    """

    def __init__(self, calibration: Calibration, shape: tuple[int, int], index: int = 0) -> None:
        sensor = calibration.sensor
        self._white_dn = sensor.white_dn
        self.dark: Image = np.full((1, shape[1]), sensor.black_dn, np.float32)
        if calibration.dark_dn is not None and calibration.dark_dn.shape == shape:
            self.dark = np.nan_to_num(calibration.dark_dn).astype(np.float32)
        self.dark = read_only(self.dark)
        gain = sensor.gain_e_per_dn
        read_e = sensor.read_noise_e or 0.0
        self._least_noise = (
            PixelNoise(0.0, 0.0) if gain is None else PixelNoise(1 / gain, (read_e / gain) ** 2 + QUANTISATION_DN2)
        )
        self._known: Mask = np.zeros(shape, np.bool_)
        if calibration.bad is not None and calibration.bad.shape == shape:
            self._known[:] = calibration.bad
        self._ranges = ring_ranges(calibration.psfs[index])
        self._steepest = steepest(calibration.psfs[index])
        self._calibration, self._shape, self._index = calibration, shape, index
        self._suspect: Mask = np.zeros(shape, np.bool_)

    def __call__(self, counts: Pixels, dark: Pixels | None = None) -> Places | None:
        """Return the defective pixels of a frame (rows, cols), as flat indices; None if there are none.

        Both frames are uint16 or float32; `dark` is that of this shot, None: the calibration's. Pixels in the
        calibration's bad mask are skipped by the outlier test only. FrameError for another shape than the
        calibration's.
        """
        counts = require_shape("frame", counts, self._shape)
        offset = self.dark if dark is None else require_shape("dark frame", np.asarray(dark, np.float32), self._shape)
        noise = self._least_noise
        found = FEW + 1
        if noise.floor_dn2 > 0:
            found = self._mark_suspects(counts, offset, noise)
        if found > FEW:  # the gain is not known, or the frame is noisier, or there are many defects
            noise = PixelNoise.measured(counts, offset, self._white_dn).at_least(noise)
            found = self._mark_suspects(counts, offset, noise)
        if not found:
            return None
        least_dn = self._least_dn(offset, noise)
        places = np.flatnonzero(self._suspect)
        light = _light_at(counts, offset, *np.divmod(places, counts.shape[1]))
        dark_dn = NOISE_SD * noise.floor_dn2**0.5
        saturated = counts.ravel()[places] >= self._white_dn
        low = (
            (light < least_dn) if np.count_nonzero(light < least_dn) <= MAX_OUTLIERS * counts.size else light < -np.inf
        )
        outlying = self._outliers(counts, offset, noise, places[~saturated & ~low])
        gap = np.count_nonzero(light <= dark_dn) >= MIN_EDGE_PX
        if not (saturated.any() or low.any() or gap):
            return outlying if outlying.size else None
        defective = np.zeros(counts.shape, np.bool_)
        defective.ravel()[np.concatenate([outlying, places[low]])] = True
        self._add_areas(counts, dark, noise, defective, bool(gap), bool(saturated.any()))
        return np.flatnonzero(defective) if defective.any() else None

    def _mark_suspects(self, counts: Pixels, offset: Image, noise: PixelNoise) -> int:
        """Mark the candidate pixels in `_suspect` and return their number.

        A candidate is saturated, below `_least_dn`, or off the mean of its four neighbours by more than NOISE_SD.
        """
        limit = NOISE_SD**2 * float(LINE)
        return kernels.mark_suspects(
            counts,
            offset,
            limit * noise.per_dn,
            limit * noise.floor_dn2,
            self._white_dn,
            self._least_dn(offset, noise),
            self._suspect,
        )

    def _add_areas(
        self, counts: Pixels, dark: Pixels | None, noise: PixelNoise, defective: Mask, gap: bool, saturated: bool
    ) -> None:
        """Mark clipped areas, gaps and halos in `defective`, which holds the single pixels."""
        offset = self.dark if dark is None else np.asarray(dark, np.float32)
        if saturated:
            white_light_dn = self._white_dn - float(offset.mean(dtype=np.float64))
            noise_dn = (noise.per_dn * white_light_dn + noise.floor_dn2) ** 0.5
            defective |= clipped(counts, self._white_dn, noise_dn)
        if gap:
            dark_dn = NOISE_SD * noise.floor_dn2**0.5
            defective |= self._gaps(np.where(defective, np.float32(0), counts - offset), dark_dn)
        if saturated and self._halo is not None:
            defective |= self._halo.mask(counts, dark, defective)

    @cached_property
    def _halo(self) -> "HaloFinder | None":
        """Halo search, planned at the first saturated frame; None if the field radius is unknown."""
        if not isfinite(field_radius_px(self._calibration)):
            return None
        return HaloFinder(self._calibration, self._shape, self._index)

    def _least_dn(self, offset: Image, noise: PixelNoise) -> float:
        """Return the lowest value of a working pixel, in DN above dark; -3e38 if the black level is too low to test."""
        black_dn = float(offset.mean(dtype=np.float64))
        margin_dn = NOISE_SD * noise.floor_dn2**0.5
        return -(LOW_SHARE * black_dn + margin_dn) if black_dn > BLACK_PER_LIMIT * margin_dn else -3e38

    def _outliers(self, counts: Pixels, offset: Image, noise: PixelNoise, places: Places) -> Places:
        """Return the outliers among `places` (flat indices); none if they exceed MAX_OUTLIERS of the pixels."""
        limit = NOISE_SD**2
        slope_dn = limit * noise.per_dn
        floor_dn2 = limit * noise.floor_dn2
        is_outlier = np.zeros(places.size, np.bool_)
        known = self._known.ravel()
        before = known[places]
        for _ in range(PASSES):
            if not kernels.outliers(counts, offset, self._known, places, slope_dn, floor_dn2, self._ranges, is_outlier):
                break
            known[places[is_outlier]] = True
        known[places] = before
        return places[is_outlier] if np.count_nonzero(is_outlier) <= MAX_OUTLIERS * counts.size else places[:0]

    def _gaps(self, light: Image, dark_dn: float) -> Mask:
        """Return the areas without light (rows, cols) whose border is sharper than the PSF permits.

        Areas up to NARROW_PX wide are below SHADOW times their surroundings or below `dark_dn`; wider ones are at most
        `dark_dn`. `light` is in DN above dark.
        """
        lit_dn = LIT * dark_dn
        around = ndimage.grey_closing(light, (NARROW_PX, NARROW_PX))
        sharp = steep(light, 0.5 * (1 + self._steepest), np.maximum(lit_dn, EDGE * around))
        narrow = (light < np.maximum(SHADOW * around, dark_dn)) & (around > lit_dn)
        wide = (light <= dark_dn) & ~narrow
        shadows = _with_sharp_border(narrow, sharp)
        # An area of 25 to 60 pixels is narrow only along its border; its middle is adjacent to that border.
        return shadows | _with_sharp_border(wide, sharp | ndimage.binary_dilation(shadows))


def steep(image: Image, share: float, least: Image) -> Mask:
    """Mark both pixels of every large step |b - c| between the neighbours b and c in a line a, b, c, d of `image`.

    Lines are rows and columns. A step is large if it exceeds `least` at b and at c and is at least `share` (0 to 1)
    times the range of a, b, c, d. `image` and `least` are (rows, cols) in DN.
    """
    out = np.zeros(image.shape, np.bool_)
    for axis in (0, 1):
        line = np.moveaxis(image, axis, 0)
        limit = np.moveaxis(least, axis, 0)
        marks = np.moveaxis(out, axis, 0)
        if len(line) < 4:
            continue
        i, j, shares = _large_steps(line, np.maximum(limit[1:-2], limit[2:-1]))
        found = shares >= share
        marks[i[found] + 1, j[found]] = True
        marks[i[found] + 2, j[found]] = True
    return out


def steepest(psf: Psf) -> float:
    """Return the largest step of the PSF as a share (0 to 1) of the range of four pixels in line, see `steep`, among
    the steps above a tenth of the PSF's maximum; 0.0 if there are none.
    """
    least = 0.1 * float(psf.pixels.max())
    lines = [line for line in (psf.pixels, psf.pixels.T) if len(line) >= 4]
    return max((float(_large_steps(line, least)[2].max(initial=0.0)) for line in lines), default=0.0)


def _large_steps(line: Image, least: Image | float) -> tuple[NDArray[np.intp], NDArray[np.intp], Image]:
    """Return the steps above `least` along the first axis: i and j of the first pixel, and the share of the range.

    A step is between the second and the third of four pixels in line; the range is that of all four.
    """
    step = np.abs(line[2:-1] - line[1:-2])
    i, j = np.nonzero(step > least)
    four = np.stack([line[i + k, j] for k in range(4)])
    return i, j, np.asarray(step[i, j] / np.ptp(four, axis=0), np.float32)


def _with_sharp_border(areas: Mask, sharp: Mask) -> Mask:
    """Return the connected areas whose border is `sharp` over EDGE_SHARE of its length, without the sensor's edge."""
    labels, count = ndimage.label(areas)
    border = areas & ~ndimage.binary_erosion(areas, border_value=1)
    length_px = np.bincount(labels[border], minlength=count + 1)
    sharp_px = np.bincount(labels[border & sharp], minlength=count + 1)
    kept = sharp_px >= np.maximum(EDGE_SHARE * length_px, 1)
    kept[0] = False
    return np.asarray(kept[labels])


class HaloFinder:
    """Search for halos of reflexes on coarse samples, for one calibration with a known field."""

    def __init__(self, calibration: Calibration, shape: tuple[int, int], index: int) -> None:
        n = max(1, round(min(shape) / HALO_SAMPLES))
        self._model = tight_model(calibration, shape, n, Planner(None, effort="FFTW_ESTIMATE"), index)
        self._shading, self._prepare = Shading(self._model), Preprocessor(calibration, self._model.grid)
        self._smooth: Image = np.zeros(self._model.grid.shape, np.float32)

    def mask(self, counts: Pixels, dark: Pixels | None, defective: Mask) -> Mask:
        """Return the halo pixels as a mask (rows, cols).

        A halo is a set of rings around a masked area in which the light exceeds the fitted smooth illumination plus
        stray light. Fit and ring test are repeated, without the halos found so far, at most HALO_REPETITIONS times.
        """
        frame = self._prepare(counts, dark, np.flatnonzero(defective))
        lost = frame.good < 0.5
        labels, count = ndimage.label(lost)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        areas = [k for k in range(1, count + 1) if sizes[k] >= MIN_AREA]
        distance, nearest = ndimage.distance_transform_edt(~lost, return_indices=True)
        owner = labels[tuple(nearest)]
        ring = np.ceil(distance).astype(np.int64)
        reach = np.zeros(count + 1, np.int64)
        good = frame.good.copy()
        for _ in range(HALO_REPETITIONS):
            excess, noise = self._excess(replace(frame, good=good, missing=1 - float(good.mean())))
            grown = reach.copy()
            for k in areas:
                grown[k] = max(reach[k], _halo_rings(excess, noise, frame.good > 0.5, ring, owner == k))
            if np.array_equal(grown, reach):
                break
            reach = grown
            good = np.where((reach[owner] > 0) & (ring <= reach[owner] + HALO_MARGIN), np.float32(0), frame.good)
        return on_sensor(good < frame.good, self._model.grid)

    def _excess(self, frame: Linear) -> tuple[Image, float]:
        """Return the light beyond the blurred smooth field as a share of it, 0 where it is dim, and its robust sd."""
        _, stray = self._shading.fit(frame, self._smooth)
        explained = self._model.blur(self._smooth)[self._model.grid.slices] + np.float32(stray)
        lit = explained > 0.2 * float(explained.max())
        excess = np.where(lit, frame.y - explained, 0) / np.maximum(explained, 1e-20)
        usable = lit & (frame.good > 0.5)
        noise = float(np.median(np.abs(excess[usable]))) / 0.6745 if usable.any() else float("inf")
        return np.asarray(excess, np.float32), noise


def _halo_rings(excess: Image, noise: float, good: Mask, ring: NDArray[np.int64], own: Mask) -> int:
    """Return the number of rings around an area, from the first on, that have an excess; 0 if there is no halo."""
    near = own & good & (ring > 0)
    rings = ring[near]
    if not rings.size:
        return 0
    number = np.bincount(rings)
    mean = np.bincount(rings, excess[near]) / np.maximum(number, 1)
    limit = np.maximum(HALO, HALO_SD * noise / np.sqrt(np.maximum(number / 4, 1)))
    first = int(np.flatnonzero(number[1:])[0]) + 1
    if mean[first] < HALO_BEGINS:
        return 0
    below = np.flatnonzero((mean[1:] <= limit[1:]) & (number[1:] > 0))
    return int(below[0]) if below.size else int(rings.max())


def clipped(counts: Pixels, white_dn: float, noise_dn: float) -> Mask:
    """Mark saturated pixels, those within SATURATED_REACH_PX of a saturated area, and those with clipped noise.

    The last kind has a local mean within CLIPPED_SD times `noise_dn` (standard deviation) of `white_dn`, at most
    CLIPPED_SHARE of it. There the converter clips the upper part of the noise, so the remaining values are too low and
    would form a border around the overexposed area. A hot pixel has dark surroundings; only that pixel is marked.
    """
    least_dn = white_dn - min(CLIPPED_SD * noise_dn, CLIPPED_SHARE * white_dn)
    found: Mask = _mean(np.minimum(counts, np.float32(white_dn)), 2 * SATURATED_REACH_PX + 1) > least_dn
    saturated: Mask = counts >= white_dn
    found |= saturated
    saturated &= _mean(saturated.astype(np.float32), 3) > (AREA_NEIGHBOURS + 0.5) / 9
    found |= ndimage.maximum_filter(saturated, 2 * SATURATED_REACH_PX + 1)
    return found


def _mean(image: Image, width_px: int) -> Image:
    """Return the means of squares in place of the image: it takes twice the counts, and memory peaks here."""
    mean: Image = ndimage.uniform_filter(image, width_px, output=image)
    return mean


def ring_ranges(psf: Psf) -> tuple[float, float]:
    """Return the excess of the PSF over its rings at distance 1 and 2 px, in units of the rings' ranges.

    The excess of a pixel is (|pixel - ring median| - noise) / trimmed ring range; it is exceeded by 1 - RANGE_SHARE of
    the pixels of at least 10 % of the peak. It is the argument `ranges` of `kernels.outliers`; infinite for a PSF with
    fewer than 5 rows or columns, 0 if no pixel off the border is so bright.
    """
    pixels = psf.pixels
    if min(pixels.shape) < 5:
        return float("inf"), float("inf")
    zero_row = read_only(np.zeros((1, pixels.shape[1]), np.float32))
    noise = PixelNoise.measured(pixels, zero_row)
    least = float(np.float32(0.1) * pixels.max())  # a float32: the count must be the kernel's
    limit = PSF_NOISE_SD**2
    no_mask = np.zeros(pixels.shape, np.bool_)
    excess = np.zeros((np.count_nonzero(pixels[2:-2, 2:-2] >= least), 2))
    kernels.ring_excess(pixels, zero_row, no_mask, least, limit * noise.per_dn, limit * noise.floor_dn2, excess)
    near, far = np.quantile(excess, RANGE_SHARE, axis=0, method="higher") if len(excess) else (0.0, 0.0)
    return float(near), float(far)


def without_hot_pixels(psf: Psf) -> Psf:
    """Return the PSF with the median of 3 x 3 pixels in the place of each hot pixel; the PSF itself without any."""
    pixels = psf.pixels
    for _ in range(PASSES):
        found = _hot_pixels(pixels)
        if not found.size:
            break
        pixels, median = pixels.copy(), ndimage.median_filter(pixels, 3)
        pixels.ravel()[found] = median.ravel()[found]
    return psf if pixels is psf.pixels else replace(psf, pixels=pixels)


def _spread(pixels: Image, places: Places) -> NDArray[np.float32]:
    """Return the light of the second darkest of a place's four neighbours over its own, both above the pixels beyond.

    The image of a point is wider than a pixel to all sides; hot pixels, even two of them side by side, are not.
    """
    around = np.pad(pixels, 2, mode="edge")
    rows, cols = (index + 2 for index in np.unravel_index(places, pixels.shape))
    near, far = (
        np.sort([around[rows - k, cols], around[rows + k, cols], around[rows, cols - k], around[rows, cols + k]], 0)[1]
        for k in (1, 2)
    )
    return np.asarray((near - far) / np.maximum(around[rows, cols] - far, np.finfo(np.float32).tiny))


def _hot_pixels(pixels: Image) -> Places:
    """Return the flat indices of the hot pixels in the image of a PSF (rows, cols), of sum 1.

    None if they are many among its bright pixels: then points are what the PSF consists of, and their rings are dark.
    """
    none = np.empty(0, np.int64)
    if min(pixels.shape) < 5:
        return none
    least = HOT_SHARE * float(np.quantile(pixels, RANGE_SHARE))
    around = np.pad(pixels, 1, constant_values=-np.inf)
    beside = np.maximum(
        np.maximum(around[:-2, 1:-1], around[2:, 1:-1]), np.maximum(around[1:-1, :-2], around[1:-1, 2:])
    )
    places = np.flatnonzero((pixels > beside + np.float32(least)) & (pixels < CORE_SHARE))
    if not places.size:
        return none
    zero_row = read_only(np.zeros((1, pixels.shape[1]), np.float32))
    known = np.zeros(pixels.shape, np.bool_)
    noise = PixelNoise.measured(pixels, zero_row)
    is_hot = np.zeros(places.size, np.bool_)
    limit = NOISE_SD**2
    kernels.outliers(pixels, zero_row, known, places, limit * noise.per_dn, limit * noise.floor_dn2, HOT_RANGES, is_hot)
    found = places[is_hot]
    found = found[_spread(pixels, found) < SPREAD_SHARE]
    are_points = float(pixels.ravel()[found].sum(dtype=np.float64)) > MAX_HOT_LIGHT
    bright = np.count_nonzero(pixels > least)
    return none if are_points or found.size > MAX_OUTLIERS * bright else found
