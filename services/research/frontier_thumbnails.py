"""Thumbnails of a frontier: one place in the best pictures within some times, in the chosen one and in the truth."""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import log
from textwrap import wrap

import numpy as np
from scipy import ndimage

from device.config.marked_files import png_bytes
from device.recon.assessment.metrics import Plane, fit_intensity
from device.values import Image, Mask
from services.plot import LEFT, Panel, text
from services.research.frontier_result import Point

TIMES_S = (0.005, 0.02, 0.07)  # of the pictures that are shown, as near as there are any
LETTERS = "ABCD"
SIDE_PX, PITCH_PX, TOP_PX, HEIGHT_PX = 140, 167, 34, 282  # of a thumbnail; from one to the next; in the panel
CROP = 0.25  # side of the crop over the shorter side of the frame
FINE = 1 / 140  # standard deviations of a spot and of its surroundings, over the side of the crop
COARSE = 1 / 28
SPOT_SD, SEEN, ERROR_SD = 1.0, 0.5, 3.0  # least contrast: in all detail; share of the truth's; in the picture's error
CAPTION_LETTERS = 118
Box = tuple[slice, slice]


@dataclass(frozen=True)
class Shown:
    """Picture (rows, cols) on the grid of the truth, and the lines of its label."""

    lines: tuple[str, ...]
    picture: Image


def nearest_points(points: Sequence[Point], most_s: float) -> tuple[Point, ...]:
    """Return the points of the Pareto front nearest to TIMES_S and below `most_s`, each once, from fast to slow."""
    front = [p for p in points if p.pareto and p.seconds_median < most_s]
    if not front:
        return ()
    chosen = {min(front, key=lambda p: abs(log(p.seconds_median / time_s))) for time_s in TIMES_S}
    return tuple(sorted(chosen, key=lambda p: p.seconds_median))


def thumbnail_panel(shown: Sequence[Shown], truth: Image, inside: Mask, simulated: bool) -> Panel:
    """Return the row of thumbnails: `shown` pictures with their letters, then the truth, and how much each shows.

    All have the intensity that fits the truth best in the region `inside`, and one grey scale. The place is the square
    of the region where the truth has most fine detail. `simulated` pictures are marked.
    """
    true = np.nan_to_num(np.asarray(truth, np.float64))
    place = detailed_place(true, inside)
    fitted = [fit_intensity(np.asarray(thumbnail.picture, np.float64), true, inside)[place] for thumbnail in shown]
    wanted = true[place]
    low, high = np.quantile(wanted, (0.002, 0.998))
    seen, spots = visible_spots(fitted, wanted)
    elements = [text(LEFT, 20, "The same place in these pictures and in the truth", "small")]
    for k, (lines, crop) in enumerate(
        zip([*(thumbnail.lines for thumbnail in shown), ("truth",)], [*fitted, wanted], strict=True)
    ):
        letter = f"{LETTERS[k]}: " if k < len(shown) else ""
        elements += _thumbnail(LEFT + k * PITCH_PX, (letter + lines[0], *lines[1:]), _png(crop, low, high, simulated))
    each = ", ".join(f"{letter} {count}" for letter, count in zip(LETTERS, seen, strict=False))
    caption = (
        f"Of the {spots} places where this crop of the truth differs most from its surroundings (vessels, spots), "
        f"these have at least half of the contrast, and {ERROR_SD:g} times the error of the picture: {each}."
    )
    for k, words in enumerate(wrap(caption, CAPTION_LETTERS)):
        elements.append(text(LEFT, TOP_PX + SIDE_PX + 76 + 16 * k, words, "small"))
    return Panel(tuple(elements), caption, HEIGHT_PX)


def detailed_place(truth: Plane, inside: Mask) -> Box:
    """Return the square inside the region where the truth (rows, cols) has most fine detail."""
    least = min(truth.shape)
    side = SIDE_PX * max(1, round(CROP * least / SIDE_PX))
    side = min(side, least // 2)
    detail = np.where(inside, _detail(truth, side), 0) ** 2
    covered = ndimage.uniform_filter(inside.astype(np.float64), side, mode="constant")
    power = ndimage.uniform_filter(detail, side, mode="constant")
    power[covered < covered.max() - 1e-6] = -1.0
    row, col = np.unravel_index(int(power.argmax()), power.shape)
    top, left = (int(np.clip(at - side // 2, 0, size - side)) for at, size in zip((row, col), truth.shape, strict=True))
    return slice(top, top + side), slice(left, left + side)


def visible_spots(crops: Sequence[Plane], truth: Plane) -> tuple[list[int], int]:
    """Return how many spots of the truth each crop shows, and how many there are.

    A spot is a place where the truth differs most from its surroundings. A crop shows it if its contrast there has the
    same sign, at least the share SEEN of the truth's, and ERROR_SD standard deviations of the crop's error.
    """
    side = truth.shape[0]
    wanted = _detail(truth, side)
    strength = np.abs(wanted)
    peaks = strength == ndimage.maximum_filter(strength, 2 * max(1, round(COARSE * side)) + 1)
    spots = peaks & (strength > SPOT_SD * wanted.std())
    counts = []
    for crop in crops:
        seen = _detail(crop, side)
        least = np.maximum(SEEN * strength, ERROR_SD * (seen - wanted).std())
        counts.append(int((spots & (seen * np.sign(wanted) >= least)).sum()))
    return counts, int(spots.sum())


def _detail(picture: Plane, side: int) -> Plane:
    fine, coarse = (ndimage.gaussian_filter(picture, share * side) for share in (FINE, COARSE))
    return np.asarray(fine - coarse)


def _thumbnail(x: float, lines: Sequence[str], png: str) -> list[str]:
    picture = (
        f'<image x="{x}" y="{TOP_PX}" width="{SIDE_PX}" height="{SIDE_PX}" href="data:image/png;base64,{png}">'
        f"<title>{escape(', '.join(lines))}</title></image>"
    )
    below = TOP_PX + SIDE_PX + 17
    return [picture, *(text(x, below + 16 * k, words, "small") for k, words in enumerate(lines))]


def _png(crop: Plane, low: float, high: float, simulated: bool) -> str:
    """Return a crop as base64 of a PNG with at most SIDE_PX pixels a side; grey from `low` to `high`."""
    n = max(1, crop.shape[0] // SIDE_PX)
    rows = crop.shape[0] // n
    cols = crop.shape[1] // n
    mean = crop[: rows * n, : cols * n].reshape(rows, n, cols, n).mean(axis=(1, 3))
    grey = np.clip((mean - low) / max(high - low, 1e-30), 0, 1) * 255
    return b64encode(png_bytes(np.round(grey).astype(np.uint8), simulated)).decode()
