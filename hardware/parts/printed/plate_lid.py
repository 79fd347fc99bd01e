"""The plate lid: closes the block's slot, and its tongue keeps the beam splitter where it is."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed.splitter_block import HALF_MM, LID_SCREW_MM, lid_screws_mm, slab
from hardware.parts.shapes import box, joined, rod_x

UP = (1.0, 0.0, 0.0)
THICK_MM = 3.0
OVERLAP_MM = 2.0


def plate_lid(d: Dimensions) -> Part:
    """A lid with a tongue as long as the room beside the plate, less a film of foam."""
    fit = d.fit
    glass = d.plate_thick_mm
    plate = d.path.relay.splitter_mm / 2
    around = LID_SCREW_MM + 2 * OVERLAP_MM
    x = (-HALF_MM - THICK_MM, -HALF_MM)
    body = slab(d, x, plate + OVERLAP_MM, (glass / 2 - around, glass / 2 + around))
    body &= box(x, (-2 * plate, 2 * plate), d.block_z_mm)  # its corners would be in the way of tube and cell
    body += slab(d, (-HALF_MM, -plate - fit.slide_mm), plate, (fit.press_mm, glass))
    return body - joined(rod_x(fit.m2_mm, x, at) for at in lid_screws_mm(d))
