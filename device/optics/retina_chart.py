"""Retina chart of the model eye: the one source of its dimensions for print, simulator and check.

    ELEMENTS                bars, marks, rings and patches, um on the paper from the optical axis (right, down)
    signed_distance_um      distance to the elements of one tone, for the simulator and the expected picture
    chart_svg               the chart to print, to scale

The chart is flat and stands at the focal distance of the model eye's lens, EYE_MM; a place h off the axis appears at
atan(h / f) (OPTICS.md 1.2). Paper is 1, and tones are reflectances relative to paper. Bars are near the axis, because
the flat paper is 2 to 4 dpt out of focus at the edge of a field of 33.4 degrees (OPTICS.md 6.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians, tan

import numpy as np

from device.values import Image

EYE_MM = 25.0  # focal length of the model eye, as the paper computes with it (OPTICS.md 1.1)
PAPER_UM = 25_000.0  # diameter of the paper disc
INK, GREY = 0.06, 0.5  # laser ink on white paper, 5 % of 80 % [estimate]; grey patch
PAPER_REFLECTANCE = 0.8  # of white paper: OPTICS.md 4.2
BARS = 3
PERIODS_UM = (250, 315, 400, 500, 630, 800, 1000, 1250)  # preferred numbers R10: each 1.26 times the one before
RING_UM = 300.0  # width
RINGS_DEG = (14.0, 20.0, 25.0)  # angle off the axis of the middle of each ring
MARK_UM, MARKS_APART_UM = 900.0, 10_000.0


@dataclass(frozen=True)
class BarGroup:
    """Three bars of half a period, as long as the group is wide: 2.5 periods; `upright` bars stand side by side."""

    right_um: float
    down_um: float
    period_um: float
    upright: bool
    tone: float = INK

    @property
    def side_um(self) -> float:
        """Side of the square that the group fills."""
        return (BARS - 0.5) * self.period_um

    def signed_distance_um(self, x_um: Image, y_um: Image) -> Image:
        """Return the signed distance to the nearest bar, um, negative inside."""
        across = x_um - np.float32(self.right_um)
        along = y_um - np.float32(self.down_um)
        if not self.upright:
            across, along = along, across
        number = np.clip(np.rint(across / np.float32(self.period_um)), -(BARS // 2), BARS // 2)
        beside = np.abs(across - number * np.float32(self.period_um)) - np.float32(self.period_um / 4)
        return np.asarray(np.maximum(beside, np.abs(along) - np.float32(self.side_um / 2)), np.float32)

    def bars_um(self) -> list[tuple[float, float, float, float]]:
        """Return left, top, width and height of each bar."""
        wide = self.period_um / 2
        half = self.side_um / 2
        found = []
        for number in range(-(BARS // 2), BARS // 2 + 1):
            begin = number * self.period_um - wide / 2
            if self.upright:
                found.append((self.right_um + begin, self.down_um - half, wide, self.side_um))
            else:
                found.append((self.right_um - half, self.down_um + begin, self.side_um, wide))
        return found


@dataclass(frozen=True)
class Disc:
    """A solid disc: a scale mark, or a patch."""

    right_um: float
    down_um: float
    diameter_um: float
    tone: float = INK

    def signed_distance_um(self, x_um: Image, y_um: Image) -> Image:
        """Return the signed distance to the edge, um, negative inside."""
        away = np.hypot(x_um - np.float32(self.right_um), y_um - np.float32(self.down_um))
        return np.asarray(away - np.float32(self.diameter_um / 2), np.float32)


@dataclass(frozen=True)
class Ring:
    """A ring around the axis at a known angle of the field."""

    angle_deg: float
    width_um: float = RING_UM
    tone: float = INK

    @property
    def radius_um(self) -> float:
        """Radius of the middle of the line on the paper."""
        return EYE_MM * 1000 * tan(radians(self.angle_deg))

    def signed_distance_um(self, x_um: Image, y_um: Image) -> Image:
        """Return the signed distance to the line, um, negative inside."""
        off = np.abs(np.hypot(x_um, y_um) - np.float32(self.radius_um))
        return np.asarray(off - np.float32(self.width_um / 2), np.float32)


Element = BarGroup | Disc | Ring

BAR_GROUPS = (
    BarGroup(712, 1500, 250, True),
    BarGroup(-506, 1500, 315, False),
    BarGroup(3200, -1500, 400, True),
    BarGroup(1600, -1500, 500, False),
    BarGroup(-312, -1500, 630, True),
    BarGroup(-2600, -1500, 800, False),
    BarGroup(-2650, 1500, 1000, True),
    BarGroup(2900, 2100, 1250, False),
)
MARKS = tuple(
    Disc(right * MARKS_APART_UM / 2, down * MARKS_APART_UM / 2, MARK_UM)
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1))
)
RINGS = tuple(Ring(angle_deg) for angle_deg in RINGS_DEG)
GREY_PATCH = Disc(2600, -4000, 1800, GREY)
INK_PATCH = Disc(-2800, -4100, 1400)
PAPER_PATCH = Disc(-2800, 4100, 1000, 1.0)  # a place without ink
ELEMENTS: tuple[Element, ...] = (*BAR_GROUPS, *MARKS, *RINGS, GREY_PATCH, INK_PATCH)


def signed_distance_um(elements: Sequence[Element], x_um: Image, y_um: Image) -> Image:
    """Return the signed distance to the nearest of some elements, um, negative inside; places are right and down, um.

    Far from an element it may be larger than the true distance, never smaller; its sign is exact.
    """
    nearest = elements[0].signed_distance_um(x_um, y_um)
    for element in elements[1:]:
        nearest = np.minimum(nearest, element.signed_distance_um(x_um, y_um))
    return nearest


def of_tone(tone: float) -> tuple[Element, ...]:
    """Return the elements printed in one tone."""
    return tuple(element for element in ELEMENTS if element.tone == tone)


def chart_svg() -> str:
    """Return the chart as SVG in millimetres, right side up as it is seen from the lens, with a control line.

    The control line under the chart is 20 mm long: a print whose line measures otherwise is not to scale.
    """
    edge_um = PAPER_UM / 2
    body = [f'<circle r="{edge_um:g}" fill="#ffffff" stroke="#808080" stroke-width="50"/>']
    body += [_drawn(element) for element in ELEMENTS]
    line = '<path d="M-10000 14000H10000M-10000 13500V14500M10000 13500V14500" stroke="#000000" stroke-width="100"/>'
    words = '<text y="15800" font-size="1200" text-anchor="middle" font-family="sans-serif">20 mm</text>'
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" width="26mm" height="30mm" viewBox="-13000 -13000 26000 30000">\n'
        "<title>Retina chart of the model eye: print at 100 %, cut along the circle</title>\n"
        + "\n".join([*body, line, words])
        + "\n</svg>\n"
    )


def _drawn(element: Element) -> str:
    """Return one element as SVG, um."""
    colour = srgb(element.tone)
    match element:
        case BarGroup():
            return "".join(
                f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" fill="{colour}"/>'
                for x, y, w, h in element.bars_um()
            )
        case Disc():
            place = f'cx="{element.right_um:g}" cy="{element.down_um:g}" r="{element.diameter_um / 2:g}"'
            return f'<circle {place} fill="{colour}"/>'
        case Ring():
            line = f'stroke="{colour}" stroke-width="{element.width_um:g}"'
            return f'<circle r="{element.radius_um:.1f}" fill="none" {line}/>'


def srgb(tone: float) -> str:
    """Return the colour of a tone for a printer: black for ink, else the sRGB grey of that reflectance."""
    if tone <= INK:
        return "#000000"
    level = round(255 * (1.055 * tone ** (1 / 2.4) - 0.055))
    return f"#{level:02x}{level:02x}{level:02x}"
