"""What is bought, as far as printed parts touch it: for pictures, and to see that nothing stands in anything else."""

from collections.abc import Callable

from build123d import Part, Plane, Solid

from device.optics.retina_chart import PAPER_UM
from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.printed import chart_piston, diffuser_cell, pinhole_piston, polariser_ring, tube_flange
from hardware.parts.printed.splitter_block import along_plate
from hardware.parts.shapes import box, joined, rod, rod_y, square


def diffuser(d: Dimensions) -> Part:
    """Its rough side touches the iris."""
    return rod(d.bought.diffuser_mm, (0, d.bought.diffuser_thick_mm))


def camera(d: Dimensions) -> Part:
    """Board and sensor with its cover glass; the board's own lens mount is off."""
    front = d.board_z_mm
    part = d.bought
    half = part.board_holes_mm / 2
    holes = joined(rod(2.5, (front, front + part.board_thick_mm), (i * half, j * half)) for i, j in FOUR)
    glass = d.image_z_mm - part.cover_to_image_mm - part.cover_glass_mm
    return square(part.board_mm, (front, front + part.board_thick_mm)) - holes + square(part.package_mm, (glass, front))


def polariser_film(d: Dimensions) -> Part:
    """The piece before the iris."""
    rear = polariser_ring.recess_z_mm(d)[1]
    return rod(d.bought.film_mm, (rear - d.bought.film_thick_mm, rear))


def led_film(d: Dimensions) -> Part:
    """The piece under the cap."""
    end = d.cap_end_y_mm
    return rod_y(d.bought.film_mm, (end - d.bought.film_thick_mm, end), (0, d.plate_z_mm))


def led_matrix(d: Dimensions) -> Part:
    """The LuMini 8 x 8 with its ears, holes and 64 LEDs."""
    part = d.bought
    (x, z) = d.led_board_at_mm
    (wide, high) = d.bought.led_board_mm
    front = d.led_y_mm + part.led_high_mm
    y = (front, front + part.led_board_thick_mm)
    ear = part.led_ear_mm
    board = box((x - wide / 2, x + wide / 2), y, (z - high / 2, z + high / 2))
    for side in (-1, 1):
        gap = (x + side * high / 2, x + side * wide / 2)
        board -= box(gap, y, (z - high / 2 + ear, z + high / 2 - ear))
    board -= joined(rod_y(3.2, y, at) for at in d.led_screws_mm)
    return board + joined(_led(d, at) for at in d.led_places_mm)


def _led(d: Dimensions, at: tuple[float, float]) -> Part:
    half = d.bought.led_mm / 2
    top = (d.led_y_mm, d.led_y_mm + d.bought.led_high_mm)
    return box((at[0] - half, at[0] + half), top, (at[1] - half, at[1] + half))


def beam_splitter(d: Dimensions) -> Part:
    """The plate; its coated face looks to lenses and LEDs."""
    plane = Plane((0, *along_plate(d, 0, 0)), z_dir=(0, -1, 1))
    return Part() + Solid.make_cylinder(d.path.relay.splitter_mm / 2, d.plate_thick_mm, plane)


def lens_tube(d: Dimensions) -> Part:
    """The end of the tube that holds the second lens."""
    _, floor = tube_flange.tube_z_mm(d)
    z = (floor - 30, floor)
    at = (0, d.lens_y_mm)
    return rod(d.bought.tube_mm, z, at) - rod(d.bought.tube_mm - 4, z, at)


def lever(d: Dimensions) -> Part:
    """The M2 screw that turns the polariser's ring."""
    at = (0, polariser_ring.lever_z_mm(d))
    return rod_y(
        d.fit.m2_forms_mm,
        (polariser_ring.WIDE_MM / 2 - polariser_ring.LEVER_DEEP_MM, diffuser_cell.SIZE_MM[1] / 2 + 4),
        at,
    )


def eye_lens(d: Dimensions) -> Part:
    """LB1761-A: two spheres and an edge."""
    part = d.bought
    back = part.eye_lens_radius_mm - part.eye_lens_thick_mm / 2
    whole = Part() + Solid.make_cylinder(part.eye_lens_mm / 2, 12, Plane((0, 0, -6)))
    for side in (-1, 1):
        whole &= Part() + Solid.make_sphere(part.eye_lens_radius_mm, Plane((0, 0, side * back)), -90, 90, 360)
    return whole


def pinhole(d: Dimensions) -> Part:
    """A foil with a hole of 275 um, drawn without it."""
    nose = pinhole_piston.nose_z_mm(d, 1)
    return rod(d.bought.pinhole_foil_mm, (nose - d.bought.pinhole_foil_thick_mm, nose))


def retina_chart(d: Dimensions) -> Part:
    """The paper disc on the nose of the chart piston."""
    nose = chart_piston.nose_z_mm(d)
    return rod(PAPER_UM / 1000, (nose, nose + d.bought.chart_paper_mm))


HEAD: dict[str, Callable[[Dimensions], Part]] = {
    "lens tubes": lens_tube,
    "beam splitter": beam_splitter,
    "LED matrix": led_matrix,
    "LED film": led_film,
    "polariser film": polariser_film,
    "lever": lever,
    "diffuser": diffuser,
    "camera": camera,
}
EYE: dict[str, Callable[[Dimensions], Part]] = {"eye lens": eye_lens, "pinhole": pinhole}
CHART: dict[str, Callable[[Dimensions], Part]] = {"eye lens": eye_lens, "retina chart": retina_chart}
