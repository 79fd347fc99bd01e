"""Fit of the printed parts with one another and with the light: distances, screws, apertures, LEDs, stray light."""

from collections.abc import Callable
from itertools import combinations
from math import cos, pi, radians, sin, tan

import numpy as np
import pytest
from manifold3d import OpType
from numpy.typing import NDArray

from device.optics import field_extent
from device.optics.led_cap import LedCap, seen_share
from device.optics.light_path import relay_of
from device.optics.matrix import ring
from device.optics.retina_chart import RINGS
from hardware.parts import assembly, bought
from hardware.parts.dimensions import FOUR, Dimensions
from hardware.parts.printed import (
    diffuser_cell,
    eye_collar,
    model_eye_tube,
    pinhole_piston,
    retaining_ring,
    splitter_block,
    tube_flange,
)
from hardware.parts.printed.iris import iris
from hardware.parts.printed.led_cap import led_cap
from hardware.parts.solids import Manifold, solid

pytestmark = pytest.mark.parts

Place = tuple[float, float, float]
Rays = NDArray[np.float64]  # directions, one per row
Solids = dict[str, Manifold]
Change = Callable[[str, str], Dimensions]
CUTS_ITS_THREAD = {("lever", "polariser ring")}
FAR_MM = 300.0
NOTHING_MM3 = 0.05  # overlap of touching tessellated faces


def common_mm3(one: Manifold, other: Manifold) -> float:
    return (one ^ other).volume()


def rod(at: tuple[float, float, float], along: tuple[float, float, float], long_mm: float, wide_mm: float) -> Manifold:
    """Return a cylinder from a point along a direction."""
    x, y, z = along
    turn = {(0, 0, 1): (0, 0, 0), (0, 0, -1): (180, 0, 0), (0, 1, 0): (-90, 0, 0), (1, 0, 0): (0, 90, 0)}[(x, y, z)]
    return Manifold.cylinder(long_mm, wide_mm / 2, -1, 48).rotate(turn).translate(at)


def bundle(*discs: tuple[float, float, float, float]) -> Manifold:
    """Return the hull of all straight rays between discs, each (diameter, x, y, z) perpendicular to the axis."""
    turns = np.linspace(0, 2 * pi, 96, endpoint=False)
    places = [(x + w / 2 * cos(a), y + w / 2 * sin(a), z) for w, x, y, z in discs for a in turns]
    return Manifold.hull_points(np.array(places))


@pytest.mark.parametrize("which", ["head", "eye", "chart_eye"])
def test_parts_do_not_overlap(which: str, request: pytest.FixtureRequest) -> None:
    parts: Solids = request.getfixturevalue(which)
    inside = {
        pair: common_mm3(parts[pair[0]], parts[pair[1]])
        for pair in combinations(sorted(parts), 2)
        if pair not in CUTS_ITS_THREAD
    }
    assert len(inside) > 9
    assert {pair: volume for pair, volume in inside.items() if volume > NOTHING_MM3} == {}


def test_overlap_of_two_parts_is_detected(head: Solids) -> None:
    assert common_mm3(head["camera"], head["sensor spacer"].translate((0, 0, 0.1))) > NOTHING_MM3


def in_air_mm(d: Dimensions, head: Solids) -> float:
    """Return the distance from diffuser to image plane in air, as stacked: iris, shoulder, cell, spacer, board."""
    low, high = head["sensor spacer"].bounding_box()[2::3]
    assert low == pytest.approx(head["diffuser cell"].bounding_box()[5], abs=1e-5)
    board = d.bought.board_mm**2
    assert head["camera"].slice(high + 0.01).area() > 0.98 * board > head["camera"].slice(high - 0.01).area()
    rough = head["iris"].bounding_box()[5]
    part = d.bought
    image = high - part.image_above_board_mm
    glass = part.diffuser_thick_mm * (1 - 1 / part.diffuser_index)
    return image - rough - glass - part.cover_glass_mm * (1 - 1 / part.cover_glass_index)


def test_spacer_gives_the_distance_of_the_light_path(d: Dimensions, head: Solids) -> None:
    assert in_air_mm(d, head) == pytest.approx(d.path.optics.diffuser_to_sensor_um / 1000, abs=1e-4)
    assert head["diffuser"].bounding_box()[2] == pytest.approx(head["iris"].bounding_box()[5], abs=1e-5)
    assert head["retaining ring"].bounding_box()[2] == pytest.approx(head["diffuser"].bounding_box()[5], abs=1e-5)


def test_iris_has_the_diameter_of_the_light_path_and_a_sharp_edge(d: Dimensions, head: Solids) -> None:
    """The iris is a 3.2 mm hole at the diffuser with a land of 0.2 mm, and no narrower aperture precedes it."""
    low, high = head["iris"].bounding_box()[2::3]
    widths = [hole_mm(head["iris"], z) for z in np.linspace(low + 0.01, high - 0.01, 9)]
    assert widths[-1] == pytest.approx(d.iris_mm, abs=0.01)
    assert widths[0] > d.iris_mm + 1.5
    assert widths == pytest.approx(sorted(widths, reverse=True), abs=1e-6)


def test_light_of_the_field_meets_no_printed_part(d: Dimensions, head: Solids) -> None:
    """The light passes from before the tube flange to the plate, the iris and the edge of the largest sensor."""
    relay, field = relay_of(d.path, d.path.optics), d.path.optics.field_deg
    before = relay.beam_before_iris_mm(field, 9.0)
    extent = d.iris_mm + 2 * field_extent.half_shift_tan_mm(relay, field)
    front = bundle((d.iris_mm - 0.02, 0, 0, -0.01), (before, 0, 0, -9.0))
    behind = bundle((d.iris_mm, 0, 0, 0.01), (extent, 0, 0, 5.0))
    far = [(relay.beam_before_iris_mm(field, -z), 0, d.lens_y_mm, z) for z in (-45.0, d.plate_z_mm)]
    printed = {name: body for name, body in head.items() if name not in {*bought.HEAD, "dust cap"}}
    light = front + behind + bundle(*far)
    assert {name for name, body in printed.items() if common_mm3(light, body) > NOTHING_MM3} == set()
    wider = bundle((d.iris_mm + 0.2, 0, 0, -0.01), (before, 0, 0, -9.0))
    assert common_mm3(wider, head["iris"]) > NOTHING_MM3


def test_block_is_wider_than_the_plate(d: Dimensions, head: Solids) -> None:
    """The tilted plate, not its block, is the narrowest aperture of the lens path and of the LED path."""
    wide, z, y = d.plate_seen_mm - 0.1, d.plate_z_mm, d.lens_y_mm
    lens = rod((0, y, d.block_z_mm[0] - 13), (0, 0, 1), z - d.block_z_mm[0] + 13, wide)
    light = rod((0, y, z), (0, 1, 0), d.cap_front_y_mm - y, wide)
    for name in ("splitter block", "tube flange", "plate lid"):
        assert common_mm3(lens + light, head[name]) < NOTHING_MM3, name


def screws(d: Dimensions) -> dict[str, list[Manifold]]:
    """Return every screw as a rod of its own width, by the part that it holds."""
    half, rear = d.bought.board_holes_mm / 2, d.cell_rear_z_mm
    x, y = diffuser_cell.SCREWS_MM
    deep = d.cell_front_z_mm - d.fit.insert_deep_mm + 0.1
    return {
        "camera": [rod((i * half, j * half, rear - 5.9), (0, 0, 1), 30, 2.5) for i, j in FOUR],
        "cell": [rod((i * x, j * y, deep), (0, 0, 1), 30, 3.0) for i, j in FOUR],
        "matrix": [rod((x, d.cap_front_y_mm - 5.9, z), (0, 1, 0), 40, 3.0) for x, z in d.led_screws_mm],
        "tube": [rod((*at, d.block_z_mm[0] + 5.9), (0, 0, -1), 40, 3.0) for at in splitter_block.tube_screws_mm(d)],
        "diffuser": [rod((*at, d.cell_rear_z_mm - 6), (0, 0, 1), 6.5, 1.6) for at in retaining_ring.screws_mm()],
        "plate": [
            rod((-splitter_block.HALF_MM - 14, *at), (1, 0, 0), 19.9, 1.6) for at in splitter_block.lid_screws_mm(d)
        ],
    }


@pytest.mark.parametrize("name", ["camera", "cell", "matrix", "tube", "diffuser", "plate"])
def test_screws_and_driver_have_free_access(d: Dimensions, head: Solids, name: str) -> None:
    """A screw of full width with a driver of the same width behind it meets no part on its way into the thread."""
    for screw in screws(d)[name]:
        met = {part for part, body in head.items() if part != "lens tubes" and common_mm3(screw, body) > NOTHING_MM3}
        assert met == set()


def test_screw_beside_its_hole_is_detected(d: Dimensions, head: Solids) -> None:
    moved = screws(d)["camera"][0].translate((0.6, 0, 0))
    assert common_mm3(moved, head["sensor spacer"]) > NOTHING_MM3


def free(body: Manifold, start: Place, ways: Rays) -> Rays:
    """Return the rays that meet no surface."""
    ends = np.array(start) + FAR_MM * ways
    met = [bool(body.ray_cast(start, tuple(end))) for end in ends.tolist()]
    return ways[~np.array(met)]


def fan(down: tuple[float, float, float], most_deg: float, count: int) -> NDArray[np.float64]:
    """Return directions spread evenly over a cone, by the golden angle."""
    n = np.arange(count) + 0.5
    along = 1 - n / count * (1 - cos(radians(most_deg)))
    turn, away = n * pi * (3 - 5**0.5), np.sqrt(1 - along**2)
    axis = np.array(down)
    u = np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.9 else (0.0, 1.0, 0.0))
    v = np.cross(axis, u)
    return along[:, None] * axis + (away * np.cos(turn))[:, None] * u + (away * np.sin(turn))[:, None] * v


def seen_through(d: Dimensions, cap: Manifold, half_deg: float) -> tuple[list[float], list[float]]:
    """Return the share of each LED's light that passes the cap, within the cone and outside every allowed direction."""
    inside, outside = [], []
    cone, rest = fan((0, -1, 0), 0.98 * half_deg, 24), fan((0, -1, 0), 89.0, 160)
    rest = rest[rest @ (0, -1, 0) < cos(radians(1.02 * half_deg))]
    for x, z in d.led_places_mm:
        start = (x, d.led_y_mm - 1e-4, z)
        inside.append(len(free(cap, start, cone)) / len(cone))
        outside.append(len(free(cap, start, rest)) / len(rest))
    return inside, outside


def test_cap_passes_light_of_the_ring_only(d: Dimensions, head: Solids) -> None:
    half_deg = relay_of(d.path, d.path.optics).led_cone_deg(d.path.optics.field_deg) / 2
    inside, outside = seen_through(d, head["LED cap"], half_deg)
    assert {i for i, part in enumerate(inside) if part == 1} == set(ring(d.path.ring))
    assert max(part for i, part in enumerate(inside) if i not in ring(d.path.ring)) == 0
    assert max(outside) == 0


def test_dies_light_the_penumbra_of_the_optics_through_the_cap(d: Dimensions, head: Solids) -> None:
    """Rays from 8 x 8 places of a die of 1 mm pass the printed hole as `seen_share` says; a point has no penumbra."""
    cap = LedCap(d.led_hole_mm, d.led_y_mm - d.cap_end_y_mm, 1.0)
    (x, z), steps = d.ring_places_mm[0], (np.arange(8) + 0.5) / 8 - 0.5
    for half_deg, turn in ((0.0, 0.0), (7.5, 0.4), (10.5, 0.0), (12.5, pi / 4), (15.0, 0.0), (21.0, pi / 4)):
        right, up = (tan(radians(half_deg)) * way for way in (cos(turn), sin(turn)))
        way = np.array([[right, -1.0, up]])
        starts = [(x + i * cap.emitter_mm, d.led_y_mm - 1e-4, z + j * cap.emitter_mm) for i in steps for j in steps]
        passed = sum(len(free(head["LED cap"], start, way)) for start in starts) / len(starts)
        assert passed == pytest.approx(float(seen_share(cap, right, up)), abs=0.06)  # four places; a hole of many sides


def test_light_reaches_the_sensor_only_along_the_axis(d: Dimensions, head: Solids) -> None:
    """Every backward ray from the sensor that meets no part has passed the iris and leaves through the lens tube."""
    clear = {"polariser film", "LED film", "diffuser", "beam splitter", "dust cap"}
    whole = Manifold.batch_boolean([body for name, body in head.items() if name not in clear], OpType.Add)
    z = d.image_z_mm - 1.2
    ways = np.concatenate([fan((0, 0, -1), 89.5, 600), fan((0, 0, -1), 30, 300)])
    for x, y in ((0, 0), (1.2, 0.9), (-1.2, 0.9)):
        out = free(whole, (x, y, z), ways)
        assert 5 < len(out) < 300
        at_tube = np.array((x, y - d.lens_y_mm)) + out[:, :2] / -out[:, 2:] * (z - tube_flange.tube_z_mm(d)[0])
        assert np.hypot(*at_tube.T).max() < d.bought.tube_mm / 2


@pytest.mark.parametrize("rings", [0, 1, 2])
def test_step_rings_set_the_distance_of_the_point_source(d: Dimensions, eye: Solids, rings: int) -> None:
    """The point source is 21, 25 and 29 mm behind the lens: -4, 0 and +4 mm from the focus."""
    thick = np.diff(eye["step ring"].bounding_box()[2::3]).item()
    nose = eye["pinhole"].bounding_box()[5] + (1 - rings) * thick
    assert -nose == pytest.approx(d.bought.eye_focal_mm + (rings - 1) * d.bought.eye_step_mm, abs=1e-4)
    assert nose == pytest.approx(pinhole_piston.nose_z_mm(d, rings), abs=1e-4)
    lens = sum(eye["eye lens"].bounding_box()[2::3]) / 2
    assert lens == pytest.approx(0, abs=1e-4)


def test_chart_is_at_the_focus_of_the_lens(d: Dimensions, chart_eye: Solids) -> None:
    """The front of the paper is 25 mm behind the lens, and nothing of the tube is before it within the widest ring."""
    assert chart_eye["retina chart"].bounding_box()[5] == pytest.approx(-d.bought.eye_focal_mm, abs=1e-4)
    light = rod((0, 0, -d.bought.eye_focal_mm + 0.01), (0, 0, 1), 10.0, 2 * RINGS[-1].radius_um / 1000)
    assert common_mm3(light, chart_eye["model eye tube"]) < NOTHING_MM3


def test_pupil_of_the_model_eye_is_that_of_the_paper(d: Dimensions, eye: Solids) -> None:
    tube = eye["model eye tube"]
    end = tube.bounding_box()[5]
    widths = [hole_mm(tube, z) for z in np.linspace(end - 1.1, end - 0.01, 9)]
    assert min(widths) == pytest.approx(d.bought.eye_pupil_mm, abs=0.02)


def test_collar_stops_eye_and_card_in_the_plane_of_the_pupil(d: Dimensions, eye: Solids) -> None:
    """The eye can be tilted by four degrees in it, as a sensor 0.3 mm beside its axis requires."""
    collar, tube, pupil = eye["eye collar"], eye["model eye tube"], model_eye_tube.pupil_z_mm(d)
    assert hole_mm(tube, pupil + 0.1) == pytest.approx(d.bought.eye_pupil_mm, abs=0.02)
    card = rod((0, 0, pupil - 0.3), (0, 0, 1), 0.3, eye_collar.CARD_MM)
    for stopped in (tube, card):
        assert common_mm3(stopped, collar) < NOTHING_MM3 < common_mm3(stopped.translate((0, 0, 0.1)), collar)
    rises = model_eye_tube.WIDE_MM / 2 * sin(radians(4))  # one side of the rim: the cone moves it sideways for that
    tilted = tube.translate((0, 0, -pupil - 0.1)).rotate((4, 0, 0)).translate((0, -eye_collar.SLOPE * rises, pupil))
    assert common_mm3(tilted, collar) < NOTHING_MM3


def test_collar_passes_the_field_and_slides_over_the_tubes(d: Dimensions, eye: Solids) -> None:
    collar, pupil = eye["eye collar"], model_eye_tube.pupil_z_mm(d)
    long, edge = 30.0, tan(radians(d.path.optics.field_deg / 2))
    light = bundle((d.bought.eye_pupil_mm, 0, 0, pupil), (d.bought.eye_pupil_mm + 2 * long * edge, 0, 0, pupil + long))
    assert common_mm3(light, collar) < NOTHING_MM3
    screws_at = eye_collar.socket_z_mm(d)[1] - eye_collar.SCREWS_FROM_END_MM
    for from_pupil_mm in (17.6, 24.1):  # 22.1 mm to the glass, within 2 mm; the glass up to 2.5 mm inside the tube
        end = pupil + from_pupil_mm
        assert common_mm3(rod((0, 0, end), (0, 0, 1), 60.0, d.bought.tube_mm), collar) < NOTHING_MM3
        assert end < screws_at - 2


def hole_mm(body: Manifold, z: float) -> float:
    """Return the width of the hole in the centre of a slice, from its corners."""
    middle = min(body.slice(z).to_polygons(), key=lambda corners: np.abs(corners).max())
    return 2 * float(np.hypot(*middle.T).max())


# Changes of optics.toml change the parts


def test_distance_determines_the_spacer(d: Dimensions, changed: Change) -> None:

    other = changed("diffuser_to_sensor_um = 6000", "diffuser_to_sensor_um = 5000")
    parts = {name: solid(assembly.printed()[name].shape(other)) for name in ("iris", "diffuser cell", "sensor spacer")}
    parts["camera"] = solid(bought.camera(other))
    assert in_air_mm(other, parts) == pytest.approx(5.0, abs=1e-4)
    assert other.board_z_mm == pytest.approx(d.board_z_mm - 1)


def test_iris_diameter_determines_the_hole(changed: Change) -> None:
    other = changed("iris_um = 3200", "iris_um = 1600")
    assert hole_mm(solid(iris(other)), -0.1) == pytest.approx(1.6, abs=0.02)


def test_plate_determines_slot_lid_and_axis(d: Dimensions, changed: Change) -> None:
    """A thinner plate fits its own slot without play, and moves the lenses' axis less."""
    other = changed("plate_mm = 5.0", "plate_mm = 3.0")
    assert other.lens_y_mm == pytest.approx(0.6 * d.lens_y_mm)
    plate, parts = solid(bought.beam_splitter(other)), assembly.printed()
    for name in ("splitter block", "plate lid"):
        assert common_mm3(plate, solid(parts[name].shape(other))) < NOTHING_MM3, name
    deeper = plate.translate((0, -0.3, 0.3))  # 0.42 mm square to the plate: more than the slot leaves
    assert common_mm3(deeper, solid(parts["splitter block"].shape(other))) > NOTHING_MM3


@pytest.mark.parametrize(
    ("was", "becomes"),
    [
        ("ring_mm = 10.04", "ring_mm = 13.47"),
        ("ring_mm = 10.04", "axis = [3, 3]\nleds = [18, 19, 20, 26, 28, 34, 35, 36]"),
        ("field_deg = 33.4", "field_deg = 45"),
    ],
)
def test_ring_and_field_determine_the_cap(changed: Change, was: str, becomes: str) -> None:

    other = changed(was, becomes)
    half_deg = relay_of(other.path, other.path.optics).led_cone_deg(other.path.optics.field_deg) / 2
    inside, outside = seen_through(other, solid(led_cap(other)), half_deg)
    assert {i for i, part in enumerate(inside) if part == 1} == set(ring(other.path.ring))
    assert max(outside) == 0
    length = other.led_y_mm - other.cap_end_y_mm
    assert other.led_hole_mm / 2 / length == pytest.approx(tan(radians(half_deg)))
