"""The retaining ring: presses diffuser and iris against the cell's shoulder, with three M2 screws."""

from math import cos, pi, sin

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import joined, rod

UP = (0.0, 0.0, -1.0)
FLANGE_MM = 1.6
FLANGE_WIDE_MM = 35.4
OPENING_MM = 16.0
SCREWS_AT_MM = 15.0  # from the axis
PRELOAD_MM = 0.1  # the nose is longer than the room for it: the flange bends, the diffuser cannot rattle


def screws_mm() -> list[tuple[float, float]]:
    """(x, y) of the three."""
    return [(SCREWS_AT_MM * cos(a), SCREWS_AT_MM * sin(a)) for a in (pi / 2, pi * 7 / 6, pi * 11 / 6)]


def retaining_ring(d: Dimensions) -> Part:
    """A flange, and a nose into the diffuser's bore; drawn as it is when the screws are tight."""
    rear = d.cell_rear_z_mm - d.fit.slide_mm
    flange = (rear - FLANGE_MM, rear)
    nose = rod(d.bought.diffuser_mm - d.fit.slide_mm, (d.bought.diffuser_thick_mm, rear))
    holes = joined(rod(d.fit.m2_mm, flange, at) for at in screws_mm())
    return rod(FLANGE_WIDE_MM, flange) + nose - rod(OPENING_MM, (0, rear)) - holes
