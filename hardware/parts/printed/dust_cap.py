"""The dust cap: goes over the lens tube's eye end, for dark frames and in the drawer."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import rod

UP = (0.0, 0.0, 1.0)
DEEP_MM = 10.0
WALL_MM = 2.0


def dust_cap(d: Dimensions) -> Part:
    """A cup; drawn where the eye would be, around the lenses' axis."""
    relay = d.path.relay
    floor = -(relay.second_mm * 2 + relay.first_mm) - 40
    at = (0, d.lens_y_mm)
    inside = d.bought.tube_mm + d.fit.slide_mm
    return rod(inside + 2 * WALL_MM, (floor, floor + DEEP_MM + WALL_MM), at) - rod(
        inside, (floor + WALL_MM, floor + DEEP_MM + WALL_MM), at
    )
