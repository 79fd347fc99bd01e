"""Every length that more than one part needs: the light path from `hardware/optics.toml`, and bought parts as measured.

The origin is the middle of the iris's edge, where it touches the diffuser; z runs with the light, towards the sensor.
y points from the plate to the LEDs, x along the rows of their board. All lengths are in mm, angles in degrees.
"""

from dataclasses import dataclass
from math import cos, radians, sin, sqrt
from pathlib import Path

from device.errors import SpecError
from device.optics.led_cap import cap_height_mm
from device.optics.lens_data import LayoutSpec, named_glass
from device.optics.light_path import LightPath, load_light_path, relay_of
from device.optics.matrix import led_positions_mm, ring
from device.optics.traced_relay import traced_relay

OPTICS = Path(__file__).parents[1] / "optics.toml"
FLANGE_PLATE_MM = 3.0
Place = tuple[float, float]
FOUR = ((1, 1), (-1, 1), (-1, -1), (1, -1))


@dataclass(frozen=True)
class Bought:
    """What is bought, from data sheets and board files; `measure` marks what differs from piece to piece."""

    diffuser_mm: float = 25.0  # measure; Edmund's catalogue calls 47-989 a disc of 25 mm
    diffuser_thick_mm: float = 0.76  # measure; a film on polycarbonate
    diffuser_index: float = 1.58
    board_mm: float = 38.0  # measure; Raspberry Pi HQ and Global Shutter camera, their mechanical drawings
    board_thick_mm: float = 1.4
    board_holes_mm: float = 30.0  # measure; square of four, 2.5 mm wide, 4 mm from the edges
    image_above_board_mm: float = 1.2  # measure: depth gauge on the cover glass, less the two lengths of glass below
    package_mm: float = 12.0
    cover_glass_mm: float = 0.5  # measure, or the sensor's data sheet
    cover_glass_index: float = 1.5
    cover_to_image_mm: float = 0.4  # from the glass's rear face
    film_mm: float = 20.0  # polariser, cut to a disc
    film_thick_mm: float = 0.3
    led_mm: float = 2.0  # APA102-2020
    led_high_mm: float = 0.9
    led_board_mm: Place = (40.64, 25.4)  # LuMini 8 x 8 with its four ears: SparkFun's own LuMini_8X8.GKO
    led_ear_mm: float = 7.62  # they are as high as that, and 7.62 wide
    led_holes_mm: Place = (33.02, 17.78)  # four of 3.2 mm: LuMini_8X8.TXT
    led_board_thick_mm: float = 1.6
    tube_mm: float = 55.9  # outside of a 2 inch lens tube (SM2)
    eye_lens_mm: float = 25.4  # LB1761-A: biconvex
    eye_lens_thick_mm: float = 9.0
    eye_lens_radius_mm: float = 24.5
    pinhole_foil_mm: float = 9.5  # a disc of foil with a hole of 275 um
    pinhole_foil_thick_mm: float = 0.1
    eye_focal_mm: float = 25.0  # the model eye as the paper computes with it
    eye_pupil_mm: float = 7.7
    chart_paper_mm: float = 0.1  # measure; matt paper of 80 to 100 g/m2, without the glue
    eye_step_mm: float = 4.0  # the screen moves by that much, either way


@dataclass(frozen=True)
class Fits:
    """What the printer and the screws want: FDM with a nozzle of 0.4 mm, or resin."""

    slide_mm: float = 0.2  # between diameters that shall slide
    press_mm: float = 0.1
    wall_mm: float = 1.2  # no wall is thinner, but for the baffles between LEDs
    baffle_mm: float = 0.6
    chamfer_mm: float = 0.8
    m3_mm: float = 3.4  # screws with clearance
    m25_mm: float = 2.8
    m2_mm: float = 2.3
    m2_forms_mm: float = 1.7  # a hole into which an M2 screw cuts its own thread
    insert_mm: float = 4.0  # heat-set inserts M2.5 and M3
    insert_deep_mm: float = 6.0


@dataclass(frozen=True)
class Dimensions:
    """The numbers of one light path, with where its planes lie."""

    path: LightPath
    bought: Bought = Bought()
    fit: Fits = Fits()

    @property
    def iris_mm(self) -> float:
        """Diameter of the iris."""
        return self.path.optics.iris_um / 1000

    @property
    def image_z_mm(self) -> float:
        """Where the sensor's image plane is: the light path's distance, and what the glass in between lengthens it by.

        A plate of thickness t and index n moves an image back by t (1 - 1/n): optics.toml counts in air.
        """
        part = self.bought
        glass = part.diffuser_thick_mm * (1 - 1 / part.diffuser_index)
        cover = part.cover_glass_mm * (1 - 1 / part.cover_glass_index)
        return self.path.optics.diffuser_to_sensor_um / 1000 + glass + cover

    @property
    def board_z_mm(self) -> float:
        """The camera board's front face."""
        return self.image_z_mm + self.bought.image_above_board_mm

    @property
    def plate_z_mm(self) -> float:
        """Middle of the coated face of the beam splitter."""
        return -self.path.relay.splitter_to_iris_mm

    @property
    def plate_thick_mm(self) -> float:
        """Thickness of the beam splitter."""
        return self._layout.plate_mm

    @property
    def _layout(self) -> LayoutSpec:
        if self.path.layout is None:
            raise SpecError(
                "the light path has no table [layout], which says how thick the beam splitter is",
                "Copy [layout] from hardware/optics.toml, with the thickness of your plate.",
            )
        return self.path.layout

    @property
    def lens_y_mm(self) -> float:
        """How far the lenses' axis lies above the iris's: the tilted plate moves what passes it sideways."""
        tilt = radians(45)
        glass = named_glass(self.path.glass, self._layout.plate_glass, "the beam splitter")
        index = glass.index(self.path.optics.wavelength_um)
        return self.plate_thick_mm * sin(tilt) * (1 - cos(tilt) / sqrt(index**2 - sin(tilt) ** 2))

    @property
    def led_y_mm(self) -> float:
        """The LEDs' light-emitting faces: as far from the plate as the iris is, whose mirror image they are."""
        return self.lens_y_mm + self.path.relay.splitter_to_iris_mm

    @property
    def led_places_mm(self) -> list[Place]:
        """(x, z) of every LED of the board."""
        return [(right, self.plate_z_mm + up) for right, up in led_positions_mm(self.path.ring)]

    @property
    def ring_places_mm(self) -> list[Place]:
        """(x, z) of those that are used."""
        return [self.led_places_mm[i] for i in ring(self.path.ring)]

    @property
    def led_board_at_mm(self) -> Place:
        """(x, z) of the LED board's middle."""
        places = self.led_places_mm
        return sum(x for x, _ in places) / len(places), sum(z for _, z in places) / len(places)

    @property
    def led_screws_mm(self) -> list[Place]:
        """(x, z) of the LED board's four screws."""
        (x, z) = self.led_board_at_mm
        (wide, high) = self.bought.led_holes_mm
        return [(x + i * wide / 2, z + j * high / 2) for i, j in FOUR]

    @property
    def led_hole_mm(self) -> float:
        """Width of the cap's holes."""
        return self.path.cap.hole_mm

    @property
    def cap_end_y_mm(self) -> float:
        """Where the cap's holes end, so that the middle of an LED sees the cone of the field and no more."""
        relay = relay_of(self.path, self.path.optics)
        half_deg = relay.led_cone_deg(self.path.optics.field_deg) / 2
        return self.led_y_mm - cap_height_mm(self.led_hole_mm, half_deg)

    @property
    def cap_front_y_mm(self) -> float:
        """Face of the cap on the block; between it and the holes lies the polariser's film."""
        return self.cap_end_y_mm - self.bought.film_thick_mm - self.fit.slide_mm

    @property
    def plate_seen_mm(self) -> float:
        """Width of the tilted plate as the light sees it: the bore of the block."""
        return self.path.relay.splitter_mm / sqrt(2)

    def light_mm(self, z_mm: float) -> float:
        """Width of the field's light so far before the iris, with room for a part around it."""
        relay = relay_of(self.path, self.path.optics)
        return relay.beam_before_iris_mm(self.path.optics.field_deg, -z_mm) + 1.0

    @property
    def block_z_mm(self) -> Place:
        """Front and rear face of the splitter block."""
        return self.plate_z_mm - self.bought.led_board_mm[1] / 2 - 1.8, self.cell_front_z_mm

    @property
    def tube_stop_z_mm(self) -> float:
        """Floor of the flange's socket, on which the lens tube ends: no lens comes nearer to the iris."""
        return self.block_z_mm[0] - FLANGE_PLATE_MM

    @property
    def pupil_to_glass_mm(self) -> float:
        """From the pupil of the eye to the first glass, with the tube at its stop.

        The stop keeps the lenses farther from the iris than the layout has them, so the eye comes nearer to them.
        """
        traced = traced_relay(self.path)
        faces = traced.lamp_surfaces
        more_mm = -self.tube_stop_z_mm - (traced.iris_at_mm - faces[-1].at_mm)
        return faces[0].at_mm - more_mm * self.path.optics.angular_magnification**2

    @property
    def cell_front_z_mm(self) -> float:
        """Face between block and cell."""
        return -9.0

    @property
    def slot_mm(self) -> float:
        """Width of the slot in which the beam splitter lies."""
        return self.plate_thick_mm + self.fit.slide_mm

    @property
    def spigot_z_mm(self) -> float:
        """End of the cell's spigot in the block: 2.4 mm deep, or what the slot of a thick plate leaves of that."""
        half = self.path.relay.splitter_mm / 2 + self.fit.slide_mm
        slot_end = self.plate_z_mm + (half + self.slot_mm) * sin(radians(45))
        return max(self.cell_front_z_mm - 2.4, slot_end + self.fit.wall_mm + self.fit.press_mm)

    @property
    def cell_rear_z_mm(self) -> float:
        """Face between cell and sensor spacer."""
        return 3.0


def dimensions(optics: Path = OPTICS) -> Dimensions:
    """Read the light path and derive all lengths; SpecError names the line of a mistake."""
    return Dimensions(load_light_path(optics))
