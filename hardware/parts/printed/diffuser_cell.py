"""The diffuser cell: the middle of the head. It centres iris and diffuser, and carries polariser and camera."""

from build123d import Part

from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.printed import iris, polariser_ring, retaining_ring
from hardware.parts.shapes import box, joined, rod

UP = (0.0, 0.0, 1.0)
SIZE_MM = (56.0, 44.0)
SPIGOT_MM = 33.8  # into the block: centres, and light has no straight way out
OPENING_MM = 14.0  # before the iris: wider than any light that reaches it
SCREWS_MM = (24.0, 15.0)  # M3 into the block, beside the camera's cover
LEVER_MM = 2.6
LEVER_SWING_MM = 12.0


def pocket_z_mm(d: Dimensions) -> float:
    """Floor under the retaining ring's flange."""
    return d.cell_rear_z_mm - retaining_ring.FLANGE_MM - d.fit.slide_mm


def diffuser_cell(d: Dimensions) -> Part:
    """A plate with a stepped bore; every thread is a heat-set insert, but for the three M2 of the retaining ring."""
    front = d.cell_front_z_mm
    rear = d.cell_rear_z_mm
    wide, high = SIZE_MM
    body = box((-wide / 2, wide / 2), (-high / 2, high / 2), (front, rear), 2 * d.fit.chamfer_mm)
    body += rod(SPIGOT_MM, (d.spigot_z_mm, front))
    bores = [
        rod(polariser_ring.WIDE_MM + d.fit.slide_mm, polariser_ring.recess_z_mm(d)),
        rod(OPENING_MM, (d.spigot_z_mm, 0)),
        rod(d.bought.diffuser_mm + d.fit.slide_mm, (-iris.THICK_MM, rear)),
        rod(retaining_ring.FLANGE_WIDE_MM + 2 * d.fit.slide_mm, (pocket_z_mm(d), rear)),
    ]
    z = polariser_ring.lever_z_mm(d)
    slot = box((-LEVER_SWING_MM / 2, LEVER_SWING_MM / 2), (0, high / 2), (z - LEVER_MM / 2, z + LEVER_MM / 2))
    holes = [rod(d.fit.m3_mm, (front, rear), (i * SCREWS_MM[0], j * SCREWS_MM[1])) for i, j in FOUR]
    half = d.bought.board_holes_mm / 2
    holes += [rod(d.fit.insert_mm, (rear - d.fit.insert_deep_mm, rear), (i * half, j * half)) for i, j in FOUR]
    holes += [rod(d.fit.m2_forms_mm, (pocket_z_mm(d) - 5, rear), at) for at in retaining_ring.screws_mm()]
    return body - joined(bores) - slot - joined(holes)
