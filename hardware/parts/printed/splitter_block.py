"""The splitter block: holds the plate at 45 degrees between lenses, LEDs and cell, and swallows what passes it."""

from math import cos, pi, sin

from build123d import Axis, Part, Plane, Solid

from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.printed import diffuser_cell
from hardware.parts.shapes import box, cone, joined, rod, rod_x, rod_y

UP = (0.0, 1.0, 0.0)
HALF_MM = 28.0
FLOOR_Y_MM = -22.0
TRAP_MM = 3.0  # of floor under the trap for the light that passes the plate
TUBE_SCREWS_MM = (
    (21, 10),
    (-21, 10),
    (-21, -4),
    (21, -4),
)  # M3 of the tube flange, from the lenses' axis; clear of the slot
LID_SCREW_MM = 6.5  # from the slot's middle, either way, square to the plate


def along_plate(d: Dimensions, along_mm: float, deep_mm: float) -> tuple[float, float]:
    """(y, z) of a place so far along the tilted plate and so deep behind its coated face."""
    u = (cos(pi / 4), sin(pi / 4))
    v = (-cos(pi / 4), sin(pi / 4))
    return (
        d.lens_y_mm + along_mm * u[0] + deep_mm * v[0],
        d.plate_z_mm + along_mm * u[1] + deep_mm * v[1],
    )


def slab(d: Dimensions, x_mm: tuple[float, float], half_mm: float, deep_mm: tuple[float, float]) -> Part:
    """A box in the plate's own tilt, between two depths behind its coated face."""
    y, z = along_plate(d, -half_mm, deep_mm[0])
    tilted = Plane((x_mm[0], y, z), x_dir=(1, 0, 0), z_dir=(0, -1, 1))
    return Part() + Solid.make_box(x_mm[1] - x_mm[0], 2 * half_mm, deep_mm[1] - deep_mm[0], tilted)


def lid_screws_mm(d: Dimensions) -> list[tuple[float, float]]:
    """(y, z) of the two M2 of the plate's lid."""
    middle = d.plate_thick_mm / 2
    return [along_plate(d, 0, middle - LID_SCREW_MM), along_plate(d, 0, middle + LID_SCREW_MM)]


def tube_screws_mm(d: Dimensions) -> list[tuple[float, float]]:
    """(x, y) of the four M3 of the tube flange."""
    return [(x, d.lens_y_mm + y) for x, y in TUBE_SCREWS_MM]


def splitter_block(d: Dimensions) -> Part:
    """A block with two crossing bores as wide as the plate looks, and a slot that ends where the plate does."""
    fit = d.fit
    (front, rear) = d.block_z_mm
    top = d.cap_front_y_mm
    body = box((-HALF_MM, HALF_MM), (FLOOR_Y_MM, top), (front, rear), fit.chamfer_mm, along=Axis.Y)
    lens = (0, d.lens_y_mm)
    bore = d.plate_seen_mm
    plate = d.path.relay.splitter_mm / 2 + fit.slide_mm
    body -= rod(bore, (front, rear), lens) + cone(bore, d.light_mm(front), (d.plate_z_mm, front), lens)
    body -= rod_y(bore, (FLOOR_Y_MM + TRAP_MM, top), (0, d.plate_z_mm))
    body -= rod(diffuser_cell.SPIGOT_MM + fit.slide_mm, (d.spigot_z_mm - fit.press_mm, rear))
    body -= slab(d, (-HALF_MM, plate), plate, (0, d.slot_mm))
    x, y = diffuser_cell.SCREWS_MM
    holes = [rod(fit.insert_mm, (rear - fit.insert_deep_mm, rear), (i * x, j * y)) for i, j in FOUR]
    holes += [rod(fit.insert_mm, (front, front + fit.insert_deep_mm), at) for at in tube_screws_mm(d)]
    holes += [rod_y(fit.insert_mm, (top - fit.insert_deep_mm, top), at) for at in d.led_screws_mm]
    holes += [rod_x(fit.m2_forms_mm, (-HALF_MM, -HALF_MM + 6), at) for at in lid_screws_mm(d)]
    return body - joined(holes)
