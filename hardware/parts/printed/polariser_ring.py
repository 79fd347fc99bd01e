"""The polariser ring: holds the film before the iris, and is turned by a screw that looks out of the cell."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import rod, rod_y

UP = (0.0, 0.0, 1.0)
THICK_MM = 6.0  # more than the slot it covers: light finds no straight way in
WIDE_MM = 28.0
LEVER_FROM_REAR_MM = 2.6
LEVER_DEEP_MM = 3.5


def recess_z_mm(d: Dimensions) -> tuple[float, float]:
    """Where the ring turns in the cell: from the spigot's end to the floor, on which the film lies."""
    return d.spigot_z_mm, d.spigot_z_mm + THICK_MM + d.fit.slide_mm


def lever_z_mm(d: Dimensions) -> float:
    """Where the lever, an M2 screw, stands out."""
    return recess_z_mm(d)[1] - LEVER_FROM_REAR_MM


def polariser_ring(d: Dimensions) -> Part:
    """A ring with a pocket for the film, which the cell's floor closes."""
    rear = recess_z_mm(d)[1]
    film = d.bought.film_mm + d.fit.slide_mm
    pocket = rod(film, (rear - d.bought.film_thick_mm - d.fit.slide_mm, rear))
    lever = rod_y(d.fit.m2_forms_mm, (WIDE_MM / 2 - LEVER_DEEP_MM, WIDE_MM / 2), (0, lever_z_mm(d)))
    opening = rod(d.bought.film_mm - 2, (rear - THICK_MM, rear))
    return rod(WIDE_MM, (rear - THICK_MM, rear)) - opening - pocket - lever
