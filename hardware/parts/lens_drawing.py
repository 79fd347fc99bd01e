"""Drawing of the plate of lenslets: plan, profile, section, vertices, and tolerances with what each costs."""

import csv
from collections.abc import Iterator, Sequence
from math import atan2, degrees, hypot
from pathlib import Path

import numpy as np
from manifold3d import CrossSection

from hardware.parts.dimensions import Dimensions
from hardware.parts.lens_plate import LensPlate, lens_plate
from hardware.parts.sheet import MEASURE, STYLE_HERE
from services.plot import document, line, polyline, text

TOLERANCES = Path(__file__).parents[1] / "lens_tolerances.csv"
CORNERS = 96  # of a circle
WIDE_PX, TALL_PX, ROW_PX = 1180, 920, 19
PLAN_PX, PLAN_AT = 130.0, (270.0, 330.0)  # a mm, and where the axis is
PROFILE_Y, STEEPER = 650.0, 10.0  # of the rim, and how much larger heights are drawn than widths
SECTION_PX, SECTION_AT = 14.0, (270.0, 740.0)
TABLE_X, TABLE_Y = 600.0, 100.0
COLUMNS_X = (0.0, 60.0, 130.0)  # of the table of vertices
TOLERANCES_Y, TOLERANCES_X = 580.0, (0.0, 225.0, 310.0, 410.0)

Place = tuple[float, float]


def lenslets(d: Dimensions) -> str:
    """Draw the plate of the head with lenslets."""
    plate = lens_plate(d)
    title = f"Plate of {len(plate.centres_mm)} lenslets, {plate.layout}, as seen from the eye; none was made"
    elements = [text(24, 32, title, "title"), *_notes(plate), *_plan(plate), *_profile(plate), *_section(plate)]
    elements += [*_vertices(plate), *_tolerances()]
    return document(WIDE_PX, TALL_PX, title, "Dimensions in mm.", elements, STYLE_HERE)


def cells(plate: LensPlate) -> Iterator[CrossSection]:
    """Yield the outline of each lens: its cap, up to the edges that it shares with its neighbours."""
    for centre in plate.centres_mm:
        cell = CrossSection.circle(plate.cap_mm, CORNERS)
        for x, y in plate.centres_mm - centre:
            if apart := hypot(x, y):
                beyond = CrossSection.square((plate.wide_mm, plate.wide_mm)).translate((apart / 2, -plate.wide_mm / 2))
                cell -= beyond.rotate(degrees(atan2(y, x)))
        yield cell.translate(tuple(centre))


def _notes(plate: LensPlate) -> list[str]:
    lines = (
        f"Equal spherical caps, R {plate.radius_mm:.3f} mm for n = {plate.index:g} at 0.55 um (f {plate.focal_mm:.3f} "
        f"mm in air; another n: R = (n - 1) f), their vertices {1000 * plate.vertex_mm:.0f} um above the rim.",
        f"Lenses towards the eye, on the iris (dashed, {plate.iris_mm:g} mm); vertices {plate.distance_mm:g} mm before "
        "the sensor, in air. All in mm; a mould is the mirror image, -x.",
    )
    return [text(24, 54 + 18 * row, words, "quiet small") for row, words in enumerate(lines)]


def _plan(plate: LensPlate) -> list[str]:
    found = []
    for number, (cell, centre) in enumerate(zip(cells(plate), plate.centres_mm, strict=True), 1):
        corners = [_plan_px((x, y)) for outline in cell.to_polygons() for x, y in outline]
        found.append(f'<path class="glass" d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in corners)}Z"/>')
        x, y = _plan_px(tuple(centre))
        found += [line(x - 3, y, x + 3, y, "measure"), line(x, y - 3, x, y + 3, "measure")]
        found.append(text(x + 5, y - 5, str(number), "small"))
    x, y = PLAN_AT
    radius = PLAN_PX * plate.iris_mm / 2
    found.append(f'<circle class="limit" fill="none" cx="{x:g}" cy="{y:g}" r="{radius:.1f}"/>')
    return found


def _plan_px(place: Place) -> Place:
    return PLAN_AT[0] + PLAN_PX * place[0], PLAN_AT[1] - PLAN_PX * place[1]


def _profile(plate: LensPlate) -> list[str]:
    """Draw the heights along x through the axis."""
    x_mm = np.linspace(-plate.half_mm, plate.half_mm, 400)
    height_mm = plate.height_mm(np.stack([x_mm, np.zeros_like(x_mm)], axis=-1))
    places = [
        (PLAN_AT[0] + PLAN_PX * x, PROFILE_Y - STEEPER * PLAN_PX * z) for x, z in zip(x_mm, height_mm, strict=True)
    ]
    right, top = places[-1][0] + 10, PROFILE_Y - STEEPER * PLAN_PX * plate.vertex_mm
    ticks = [line(right - 6, y, right + 6, y, "measure") for y in (PROFILE_Y, top)]
    return [
        polyline(places, "edge"),
        line(right, PROFILE_Y, right, top, "measure"),
        *ticks,
        text(right + 8, (PROFILE_Y + top) / 2 + 4, f"{plate.vertex_mm:.3f}", MEASURE),
        text(PLAN_AT[0], PROFILE_Y + 20, f"profile at y = 0, heights {STEEPER:g} times larger", "small", "middle"),
    ]


def _section(plate: LensPlate) -> list[str]:
    (x, y), half = SECTION_AT, SECTION_PX * plate.wide_mm / 2
    tall = SECTION_PX * plate.thick_mm
    below = y + tall + 16
    return [
        f'<path class="glass" d="M{x - half:.1f} {y:.1f}h{2 * half:.1f}v{tall:.1f}h{-2 * half:.1f}Z"/>',
        line(x - SECTION_PX * plate.half_mm, y, x + SECTION_PX * plate.half_mm, y, "limit"),
        line(x - half, below, x + half, below, "measure"),
        *(line(at, below - 6, at, below + 6, "measure") for at in (x - half, x + half)),
        text(
            x,
            below + 16,
            f"{plate.wide_mm:g} wide, {plate.thick_mm:g} thick; lenses on the dashed line",
            MEASURE,
            "middle",
        ),
    ]


def _vertices(plate: LensPlate) -> Iterator[str]:
    rows = [("lens", "x", "y"), *((str(k), f"{x:+.3f}", f"{y:+.3f}") for k, (x, y) in enumerate(plate.centres_mm, 1))]
    yield from _rows(rows, TABLE_Y, COLUMNS_X)


def _tolerances() -> Iterator[str]:
    with TOLERANCES.open(encoding="utf-8", newline="") as lines:
        yield from _rows(list(csv.reader(lines)), TOLERANCES_Y, TOLERANCES_X)


def _rows(rows: Sequence[Sequence[str]], top: float, columns: tuple[float, ...]) -> Iterator[str]:
    for number, row in enumerate(rows):
        for at, words in zip(columns, row, strict=True):
            if words:
                yield text(TABLE_X + at, top + ROW_PX * number, words, "small" if number else "small quiet")
