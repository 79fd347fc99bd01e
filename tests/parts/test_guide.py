"""Agreement of pictures and text of the assembly guide with the printed parts."""

import csv
import re
from dataclasses import replace
from math import atan, cos, radians, sin, tan

import pytest

from device.optics.light_path import relay_of
from hardware.parts.dimensions import FLANGE_PLATE_MM, Dimensions
from hardware.parts.pictures import PICTURES
from hardware.parts.printed import camera_cover, iris, led_cover, plate_lid, retaining_ring, tube_flange
from tests.project_files import ROOT, text

pytestmark = pytest.mark.parts


@pytest.mark.parametrize("name", list(PICTURES))
def test_picture_is_up_to_date(d: Dimensions, name: str) -> None:
    """`make part-pictures` writes the same picture."""
    assert PICTURES[name](d) == (ROOT / "hardware" / "pictures" / f"parts-{name}.svg").read_text(encoding="utf-8")


def test_light_path_determines_the_picture(d: Dimensions) -> None:
    optics = d.path.optics.model_copy(update={"diffuser_to_sensor_um": 9000})
    other = replace(d, path=d.path.model_copy(update={"optics": optics}))
    assert "6 mm in air" in text("hardware/pictures/parts-section.svg")
    assert "9 mm in air" in PICTURES["section"](other)


def cone_share(d: Dimensions, hole_mm: float) -> float:
    """Return the cone of an LED behind a hole of the cap of some width, in cones of the width that is drawn."""
    return atan(hole_mm / 2 / (long := d.led_y_mm - d.cap_end_y_mm)) / atan(d.led_hole_mm / 2 / long)


def lit(d: Dimensions, azimuth_deg: float) -> int:
    """Return the number of ring LEDs whose light of the field edge reaches the centre of the tilted plate."""
    edge = radians(relay_of(d.path, d.path.optics).led_cone_deg(d.path.optics.field_deg) / 2)
    slope_x, slope_z = (tan(edge) * part(radians(azimuth_deg)) for part in (cos, sin))
    count = 0
    for x, z in d.ring_places_mm:
        off, long = z - d.plate_z_mm, d.path.relay.splitter_to_iris_mm
        end = (long - off) / (1 + slope_z)
        along = off + slope_z * end
        count += (x + slope_x * end) ** 2 + 2 * along**2 <= (d.path.relay.splitter_mm / 2) ** 2
    return count


def test_guide_has_the_figures_of_the_models(d: Dimensions) -> None:
    leds = [lit(d, azimuth) for azimuth in range(0, 360, 15)]
    spacer, glass = d.board_z_mm - d.cell_rear_z_mm, d.image_z_mm - d.path.optics.diffuser_to_sensor_um / 1000
    figures = [
        f"**sensor spacer**, {spacer:.2f} mm thick",
        f"glass in between takes {glass:.2f} mm",
        f"than {-tube_flange.tube_z_mm(d)[1]:g} mm. Its axis is {d.lens_y_mm:.2f} mm above",
        f"holes is {d.led_hole_mm:.2f} mm wide and {d.led_y_mm - d.cap_end_y_mm:.2f} mm long",
        f"edge of the field {sum(leds) / len(leds) / 8:.2f} of it",
        f"film**, {d.bought.film_mm:g} mm,",
        f"the diffuser ({d.bought.diffuser_mm:g} mm, {d.bought.diffuser_thick_mm:g} mm",
        f"the cap's walls of {d.fit.baffle_mm:g} mm nor the iris's edge of {iris.LAND_MM:g} mm",
        f"cap's holes are {100 * (cone_share(d, d.led_hole_mm + 0.1) - 1):.0f} % of the field",
        f"the plate ({d.plate_thick_mm:g} mm",
        f"over its board ({d.bought.image_above_board_mm:g} mm)",
    ]
    guide = " ".join(text("hardware/assembly.md").split())
    assert [figure for figure in figures if figure not in guide] == []
    assert (min(leds), max(leds)) == (4, 8)
    assert "four LEDs of eight" in guide
    wide = replace(d, path=d.path.model_copy(update={"relay": d.path.relay.model_copy(update={"splitter_mm": 50.8})}))
    assert min(lit(wide, azimuth) for azimuth in range(0, 360, 15)) == 8


def test_screws_on_the_bill_have_the_right_length(d: Dimensions) -> None:
    """Each screw exceeds the joined thickness by at least its own width, and by less than the depth of its thread."""
    back = d.led_y_mm + d.bought.led_high_mm + d.bought.led_board_thick_mm
    board = d.board_z_mm + d.bought.board_thick_mm
    joins = {  # name in the guide: joined thickness, depth of the thread
        "M2.5 x 20": (board + camera_cover.ROOM_MM + d.fit.wall_mm - d.cell_rear_z_mm, d.fit.insert_deep_mm),
        "M3 x 16": (d.cell_rear_z_mm - d.cell_front_z_mm, d.fit.insert_deep_mm),
        "M3 x 20": (back + led_cover.ROOM_MM + led_cover.ROOF_MM - d.cap_front_y_mm, d.fit.insert_deep_mm),
        "M3 x 8": (FLANGE_PLATE_MM, d.fit.insert_deep_mm),
        "M2 x 8": (plate_lid.THICK_MM, 6.0),
        "M2 x 6": (retaining_ring.FLANGE_MM, 5.0),
    }
    with (ROOT / "hardware" / "parts.csv").open(encoding="utf-8", newline="") as lines:
        bill = next(row["what_for"] for row in csv.DictReader(lines) if row["part"] == "screws")
    for screw, (joined_mm, thread_mm) in joins.items():
        wide_mm, long_mm = map(float, re.findall(r"[\d.]+", screw))
        assert screw in bill
        assert wide_mm <= long_mm - joined_mm + 0.3 <= thread_mm + 0.3, screw


def test_camera_screw_without_washer_needs_the_height_that_the_guide_names(d: Dimensions) -> None:
    """Below that height of the sensor over its board the screw's end meets the hole's before it clamps."""
    low = replace(d, bought=replace(d.bought, image_above_board_mm=0.0))
    joined_mm = low.board_z_mm + low.bought.board_thick_mm + camera_cover.ROOM_MM + d.fit.wall_mm - d.cell_rear_z_mm
    least_mm = 20 - d.fit.insert_deep_mm - joined_mm
    assert f"`image_above_board_mm` is below {least_mm:.2f} mm" in text("hardware/assembly.md")


def test_screws_of_gate_board_and_computer_reach_through_the_base() -> None:
    """Board, spacer, the thickest base and the nut leave two turns of thread; ISO 4032: M2.5 is 2.0 mm, pitch 0.45."""
    bill, wired = text("hardware/parts.csv"), " ".join(text("hardware/wiring.md").split())
    base = re.search(r"base of wood or plastic, 3 to (\d) mm thick", wired)
    screw, spacer = re.search(r"M2.5 x (\d+) with nuts", bill), re.search(r"nuts and spacers of (\d) mm, eight", bill)
    assert base is not None
    assert screw is not None
    assert spacer is not None
    assert f"M2.5 x {screw[1]} **screws**" in wired
    board_mm, nut_mm = 1.6, 2.0
    assert f"{board_mm:g} mm thick: gate/gate.kicad_pcb" in bill
    assert float(screw[1]) - board_mm - float(spacer[1]) - float(base[1]) - nut_mm >= 2 * 0.45
