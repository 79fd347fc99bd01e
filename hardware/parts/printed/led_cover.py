"""The LED cover: presses the matrix onto the cap; wires leave it through a slot."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed.led_cap import outline_mm
from hardware.parts.shapes import box, joined, rod_y

UP = (0.0, -1.0, 0.0)
ROOM_MM = 5.0  # for solder joints, the capacitors and the bend of the wires
ROOF_MM = 1.6
PILLAR_MM = 7.0
WIRES_MM = 10.0


def led_cover(d: Dimensions) -> Part:
    """A lid with a pillar on every ear of the board."""
    fit = d.fit
    back = d.led_y_mm + d.bought.led_high_mm + d.bought.led_board_thick_mm
    (x0, x1), (z0, z1) = outline_mm(d)
    roof = back + ROOM_MM
    wall = fit.wall_mm
    body = box((x0, x1), (back, roof + ROOF_MM), (z0, z1))
    body -= box((x0 + wall, x1 - wall), (back, roof), (z0 + wall, z1 - wall))
    body += joined(rod_y(PILLAR_MM, (back, roof), at) for at in d.led_screws_mm)
    middle = d.led_board_at_mm[1]
    body -= box((x0, x0 + 2 * wall), (roof - 3, roof), (middle - WIRES_MM / 2, middle + WIRES_MM / 2))
    return body - joined(rod_y(fit.m3_mm, (back, roof + ROOF_MM), at) for at in d.led_screws_mm)
