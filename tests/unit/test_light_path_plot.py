"""Drawing of the light path: complete, to scale, and legible for every sensor and eye."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.config.head_file import load_head
from device.config.sensors import known_sensors
from device.optics import field_extent
from device.optics.budget import Design, design_of_head, design_of_sensor, optical_budget
from device.optics.eye import Relay
from device.optics.light_path import led_ray_mm, load_light_path, planes_mm, ray_mm
from services.workshop.light_path_plot import draw_light_path
from tests.drawings import boxes, overlapping

HARDWARE = Path(__file__).parents[2] / "hardware"
PATH = load_light_path(HARDWARE / "optics.toml")
RELAY = Relay()


def designs() -> Iterator[tuple[str, Design]]:
    for name, sensor in known_sensors().items():
        yield name, design_of_sensor(PATH, sensor)
    for head in sorted((HARDWARE / "heads").glob("*.toml")):
        if load_head(head).optics is None:
            continue  # a bench without an eye has no light path
        yield f"head-{head.stem}", design_of_head(PATH, load_head(head))


@pytest.mark.parametrize("design", [pytest.param(design, id=name) for name, design in designs()])
@pytest.mark.parametrize(("eye_mm", "pupil_mm"), [(17.0, 7.7), (25.0, 7.7), (12.0, 2.0), (35.0, 10.0), (5.0, 0.1)])
def test_labels_do_not_overlap_and_lie_inside(design: Design, eye_mm: float, pupil_mm: float) -> None:
    root = ElementTree.fromstring(draw_light_path(replace(design, eye_mm=eye_mm, pupil_mm=pupil_mm)))
    found = boxes(root)
    assert len(found) > 20
    assert overlapping(found) == []
    wide, tall = float(root.get("width", 0)), float(root.get("height", 0))
    assert not [box for box in found if box.left < 0 or box.right > wide or box.top < 0 or box.bottom > tall]


@given(st.floats(-25, 25), st.floats(-1.2, 1.2))
def test_traced_ray_agrees_with_the_relay_formulas(angle: float, height: float) -> None:
    """Tracing lens after lens gives the relay formulas of `Relay`."""
    *_, (_, iris_mm), (_, sensor_mm) = ray_mm(RELAY, 17, height, angle)
    assert iris_mm == pytest.approx(-height * RELAY.pupil_magnification, abs=1e-9)
    shift_mm = field_extent.half_shift_tan_mm(RELAY, 2 * abs(angle)) * (1 if angle < 0 else -1)
    assert sensor_mm - iris_mm == pytest.approx(shift_mm, abs=1e-9)


@given(st.floats(-6, 6), st.floats(-12.5, 12.5))
def test_led_is_imaged_into_the_pupil_and_collimated_between_the_lenses(led: float, angle: float) -> None:
    """The image is independent of the direction.

    The plate mirrors: the paths from LED and iris to the second lens are equal.
    """
    start, plate, second, first, pupil = led_ray_mm(PATH, RELAY, led, angle)
    assert pupil[1] == pytest.approx(-led * RELAY.angular_magnification, abs=1e-9)
    assert (second[1] - first[1]) / (second[0] - first[0]) == pytest.approx(led / RELAY.second_mm, abs=1e-9)
    assert plate[0] - plate[1] == pytest.approx(planes_mm(RELAY)[2] - PATH.relay.splitter_to_iris_mm, abs=1e-9)
    assert abs(complex(*start) - complex(*plate)) == pytest.approx(
        abs(complex(planes_mm(RELAY)[2], led) - complex(*plate)), abs=1e-9
    )


def test_drawing_is_to_scale() -> None:
    """The bars beside the enlargement have their stated lengths at 25 px per millimetre."""
    design = design_of_sensor(PATH, known_sensors()["imx296"])
    budget = optical_budget(design)
    bars = [
        path.get("d", "").split()
        for path in ElementTree.fromstring(draw_light_path(design)).iter()
        if path.get("style") is not None
    ]
    long_px, short_px, light_px = (float(d[4]) - float(d[2]) for d in bars)
    assert long_px == pytest.approx(25 * budget.long.sensor_mm, abs=0.2)
    assert short_px == pytest.approx(25 * budget.short.sensor_mm, abs=0.2)
    assert light_px == pytest.approx(25 * budget.extent_tan_mm, abs=0.2)
