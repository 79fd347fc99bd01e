"""The camera cover: keeps light from the board's back, and clamps board and spacer onto the cell."""

from build123d import Part

from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.shapes import box, joined, rod, square

UP = (0.0, 0.0, -1.0)
ROOM_MM = 7.0  # behind the board: chips and the bend of the flat cable
PILLAR_MM = 5.5
CABLE_MM = (18.0, 2.0)


def camera_cover(d: Dimensions) -> Part:
    """A box over board and spacer, down to the cell: its rim lets no light in, and the cable leaves upwards."""
    back = d.board_z_mm + d.bought.board_thick_mm
    begin = d.cell_rear_z_mm + d.fit.slide_mm
    end = back + ROOM_MM + d.fit.wall_mm
    inside = d.bought.board_mm + 2 * d.fit.slide_mm
    half = d.bought.board_holes_mm / 2
    shell = square(inside + 2 * d.fit.wall_mm, (begin, end), d.fit.chamfer_mm)
    shell -= square(inside, (begin, back + ROOM_MM))
    at = [(i * half, j * half) for i, j in FOUR]
    shell += joined(rod(PILLAR_MM, (back, end), place) for place in at)
    wide, high = CABLE_MM
    slot = box((-wide / 2, wide / 2), (0, inside), (back + d.fit.slide_mm, back + d.fit.slide_mm + high))
    return shell - slot - joined(rod(d.fit.m25_mm, (begin, end), place) for place in at)
