"""Where the retina chart of the model eye lies in a picture: scale, turn and place, by correlation with the chart.

    fit_chart       finds the chart; `ChartFit` maps places on the chart to pixels and says how well they agree
    modulation      contrast of one group of bars, 1 if it is as high as that of paper and ink
    lit_diameter_px diameter of the lit field

The expected picture is drawn from `device/optics/retina_chart.py`, not by the simulator.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize

from device.optics import retina_chart
from device.optics.retina_chart import BarGroup, Disc
from device.values import Image

SAMPLES_PER_DEG = 4.0  # of the picture that is compared; the bars that decide are wider
SOFT_DEG = 0.4  # width of an edge in the expected picture: the half-period that a head resolves
RADIUS_DEG = 13.4  # the part of the chart within its first ring
FIELD_MARGIN_DEG = 1.5  # a chart so far off the axis is still whole
SCALES = np.arange(-3, 4) * 0.05 + 1  # of the expected scale
TURNS_DEG = np.arange(0, 360, 10)
SEARCH_DEG = 4.0  # shift of the chart from the middle of the frame, either way
CORE = 0.5  # middle part of a bar and of a gap that is averaged
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ChartFit:
    """Place of the chart in a picture: its axis at (row, col), px; turned clockwise by `turn_deg`; `agreement` to 1."""

    row: float
    col: float
    px_per_deg: float
    turn_deg: float
    agreement: float

    def places_px(self, right_um: Floats, down_um: Floats) -> tuple[Floats, Floats]:
        """Return (rows, cols) of places on the chart: a place appears at atan(h / f)."""
        height = np.hypot(right_um, down_um)
        angle = np.degrees(np.arctan(height / (1000 * retina_chart.EYE_MM)))
        per_um = self.px_per_deg * np.where(height > 0, angle / np.maximum(height, 1e-9), 0)
        x = right_um * per_um
        y = down_um * per_um
        turn = radians(self.turn_deg)
        return self.row + x * sin(turn) + y * cos(turn), self.col + x * cos(turn) - y * sin(turn)


def fit_chart(picture: Image, px_per_deg: float, field_deg: float) -> ChartFit:
    """Return the place of the chart in a picture (rows, cols) whose expected scale is `px_per_deg`.

    The scale is searched within 15 %, the turn over the whole circle, the place within 4 degrees of the middle.
    `agreement` is the correlation coefficient within the first ring or the field: 0 without a chart.
    """
    n = max(1, int(px_per_deg / SAMPLES_PER_DEG))
    small = _reduced(picture, px_per_deg, field_deg, n)
    per_deg = px_per_deg / n
    radius_deg = min(RADIUS_DEG, field_deg / 2 - FIELD_MARGIN_DEG)
    start = _coarse(small, per_deg, radius_deg)
    steps = np.array([0.5, 0.5, 0.02, 3.0])

    def loss(x: Floats) -> float:
        trial = ChartFit(
            start.row + x[0] * steps[0],
            start.col + x[1] * steps[1],
            start.px_per_deg * (1 + x[2] * steps[2]),
            start.turn_deg + x[3] * steps[3],
            0.0,
        )
        return -_agreement(small, trial, radius_deg)

    corners = np.vstack([np.zeros(4), np.eye(4)])
    best = optimize.minimize(
        loss,
        np.zeros(4),
        method="Nelder-Mead",
        options={"initial_simplex": corners, "xatol": 2e-3, "fatol": 1e-6, "maxfev": 400},
    )
    row, col, scale, turn = best.x * steps
    middle = [(size - 1) / 2 for size in picture.shape]
    inner = [(size - 1) / 2 for size in small.shape]
    return ChartFit(
        float(middle[0] + n * (start.row + row - inner[0])),
        float(middle[1] + n * (start.col + col - inner[1])),
        float(n * start.px_per_deg * (1 + scale)),
        float((start.turn_deg + turn) % 360),
        -float(best.fun),
    )


def modulation(picture: Image, fit: ChartFit, group: BarGroup) -> float:
    """Return the lower of the two gaps' brightness above the mean of their bars, 1 if as paper is above ink.

    Paper and ink are measured on the patches of the chart.
    """
    paper = patch(picture, fit, retina_chart.PAPER_PATCH)
    ink = patch(picture, fit, retina_chart.INK_PATCH)
    if paper <= ink:
        return 0.0
    along = np.linspace(-0.4, 0.4, 25) * group.side_um
    profile = []
    for number in range(-2, 3):  # bar, gap, bar, gap, bar, half a period apart
        across = group.period_um / 2 * (number + np.linspace(-CORE, CORE, 7) / 2)
        sides = (across[:, None], along[None, :])
        right, down = np.broadcast_arrays(*(sides if group.upright else sides[::-1]))
        profile.append(_mean(picture, fit, right + group.right_um, down + group.down_um))
    gaps = [profile[k] - (profile[k - 1] + profile[k + 1]) / 2 for k in (1, 3)]
    return float(min(gaps) / (paper - ink))


def patch(picture: Image, fit: ChartFit, disc: Disc) -> float:
    """Return the mean of the picture over the inner half of a patch."""
    steps = np.linspace(-1, 1, 15) * disc.diameter_um / 4
    right, down = np.broadcast_arrays(steps[None, :], steps[:, None])
    inside = np.hypot(right, down) <= disc.diameter_um / 4
    return _mean(picture, fit, right[inside] + disc.right_um, down[inside] + disc.down_um)


def lit_diameter_px(picture: Image, px_per_deg: float) -> float:
    """Return the diameter of the disc with the area that is brighter than half of the lit level, holes filled."""
    level = ndimage.gaussian_filter(picture, 0.3 * px_per_deg)
    bright = level > 0.5 * np.median(level[level > 0.3 * np.quantile(level, 0.98)])
    areas, count = ndimage.label(ndimage.binary_fill_holes(bright))  # a ring of the chart parts its rim from the rest
    if count == 0:
        return 0.0
    largest = np.max(ndimage.sum_labels(np.ones_like(picture), areas, range(1, count + 1)))
    return float(2 * np.sqrt(largest / np.pi))


def _mean(picture: Image, fit: ChartFit, right_um: Floats, down_um: Floats) -> float:
    rows, cols = fit.places_px(right_um, down_um)
    values = ndimage.map_coordinates(picture, np.stack([rows.ravel(), cols.ravel()]), order=1, mode="nearest")
    return float(values.mean())


def _reduced(picture: Image, px_per_deg: float, field_deg: float, n: int) -> Image:
    """Return the middle of the picture as means of n x n pixels: the field and what a chart may be off it."""
    half = int(px_per_deg * (field_deg / 2 + SEARCH_DEG)) // n + 1
    counts = [min(half, size // (2 * n)) for size in picture.shape]
    starts = [(size - 2 * count * n) // 2 for size, count in zip(picture.shape, counts, strict=True)]
    part = picture[tuple(slice(a, a + 2 * c * n) for a, c in zip(starts, counts, strict=True))]
    blocks: Image = part.reshape(2 * counts[0], n, 2 * counts[1], n).mean(axis=(1, 3))
    return blocks


def _expected(shape: Iterable[int], trial: ChartFit, radius_deg: float) -> tuple[Image, Image]:
    """Return the expected picture (paper 1) and the mask of its compared part, both float32 (rows, cols)."""
    rows, cols = (np.arange(size, dtype=np.float32) for size in shape)
    x = (cols - np.float32(trial.col))[None, :]
    y = (rows - np.float32(trial.row))[:, None]
    turn = radians(trial.turn_deg)
    right = x * cos(turn) + y * sin(turn)
    down = y * cos(turn) - x * sin(turn)
    angle = np.hypot(right, down) / np.float32(trial.px_per_deg)
    stretch = 1000 * retina_chart.EYE_MM * np.tan(np.radians(np.minimum(angle, 60)))
    per_px = stretch / np.maximum(angle * np.float32(trial.px_per_deg), 1e-6)
    right_um, down_um = (np.asarray(off * per_px, np.float32) for off in (right, down))
    soft_um = radians(SOFT_DEG) * 1000 * retina_chart.EYE_MM
    plane = np.ones(angle.shape, np.float32)
    for tone in (retina_chart.INK, retina_chart.GREY):
        away = retina_chart.signed_distance_um(retina_chart.of_tone(tone), right_um, down_um)
        plane -= np.float32(1 - tone) * np.clip(0.5 - away / np.float32(soft_um), 0, 1)
    return plane, np.asarray(angle <= radius_deg, np.float32)


def _agreement(small: Image, trial: ChartFit, radius_deg: float) -> float:
    """Return the correlation coefficient of picture and expected picture within the mask."""
    plane, mask = _expected(small.shape, trial, radius_deg)
    inside = mask > 0
    seen = small[inside]
    wanted = plane[inside]
    if inside.sum() < 100 or seen.std() == 0:
        return 0.0
    return float(np.corrcoef(seen, wanted)[0, 1])


def _coarse(small: Image, px_per_deg: float, radius_deg: float) -> ChartFit:
    """Return the best place over all scales, turns and whole samples of shift, by cross-correlation."""
    middle = [(size - 1) / 2 for size in small.shape]
    reach = [min(int(SEARCH_DEG * px_per_deg), size // 4) for size in small.shape]
    size = [fft.next_fast_len(n + 2 * r, real=True) for n, r in zip(small.shape, reach, strict=True)]
    window = np.ix_(*(np.arange(-r, r + 1) for r in reach))

    def correlated(spectrum: NDArray[np.complex64], drawn: Image) -> Image:
        found: Image = fft.irfft2(spectrum * np.conj(fft.rfft2(drawn, size)), size)[window]
        return found

    seen = fft.rfft2(small, size)
    squared = fft.rfft2(small**2, size)
    best = ChartFit(middle[0], middle[1], px_per_deg, 0.0, -1.0)
    for scale in SCALES * px_per_deg:
        mask = _expected(small.shape, ChartFit(middle[0], middle[1], scale, 0.0, 0.0), radius_deg)[1]
        count = float(mask.sum())
        variance = np.maximum(correlated(squared, mask) - correlated(seen, mask) ** 2 / count, 1e-12)
        for turn in TURNS_DEG:
            plane = _expected(small.shape, ChartFit(middle[0], middle[1], scale, float(turn), 0.0), radius_deg)[0]
            plane = (plane - (plane * mask).sum() / count) * mask
            agreements = correlated(seen, plane) / np.sqrt(variance * max(float((plane**2).sum()), 1e-12))
            row, col = np.unravel_index(np.argmax(agreements), agreements.shape)
            if (found := float(agreements[row, col])) > best.agreement:
                place = middle[0] + float(row) - reach[0], middle[1] + float(col) - reach[1]
                best = ChartFit(place[0], place[1], float(scale), float(turn), found)
    return best
