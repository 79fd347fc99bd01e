"""First-order optics: each formula against a figure of the paper or of a hand calculation."""

from math import degrees, radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.config.head_file import OpticsSpec
from device.config.sensors import known_sensors
from device.optics import field_extent
from device.optics.diffuser import opd_sigma_um, slope_sigma
from device.optics.eye import (
    Relay,
    beam_walk_mm,
    correction_dpt,
    field_deg,
    iris_overlap,
    reflex_free_mm,
    size_mm,
)
from tests.textbook.image_surfaces import petzval_mm

PAPER = Relay()
DOT_PX = 275 / PAPER.retina_um_per_px(5.04, 25)  # diameter on the sensor of a dot of 275 um on the retina
OPTICS = OpticsSpec(iris_um=3200, diffuser_to_sensor_um=6000, angular_magnification=0.75, field_deg=33.4)

GOLDEN = {
    "15 mm ruler, deg": (field_deg(15), 33.39849),
    "24 mm screen, deg": (field_deg(24), 51.28201),
    "screen 4 mm farther, dpt": (correction_dpt(29), -5.51724),
    "screen 4 mm nearer, dpt": (correction_dpt(21), 7.61905),
    "angular magnification": (PAPER.angular_magnification, 0.75),
    "pupil magnification": (PAPER.pupil_magnification, 4 / 3),
    "pixels per degree": (PAPER.px_per_deg(5.04), 15.58330),
    "um per pixel, model eye": (PAPER.retina_um_per_px(5.04, 25), 28.0),
    "um per pixel, human eye": (PAPER.retina_um_per_px(5.04, 17), 19.04),
    "s at 50 deg, mm": (field_extent.half_shift_mm(PAPER, 50), 1.96350),
    "d + 2s at 50 deg, mm": (field_extent.extent_mm(PAPER, 50), 7.12699),
    "widest field, long side": (field_extent.strict_field_deg(PAPER, 9.6768), 82.46),
    "widest field, short side": (field_extent.strict_field_deg(PAPER, 5.4432), 28.56),
    "slope of the diffuser, mrad": (1000 * slope_sigma(OPTICS), 3.7059),
    "path of the diffuser, um": (opd_sigma_um(OPTICS), 0.18343),
    "scale per dioptre": (PAPER.scale_per_dpt(), 0.003375),
    "edge shift, um per dpt": (PAPER.scale_per_dpt() * PAPER.iris_mm / 2 * 1000, 5.4),
    "dot on the sensor, px": (DOT_PX, 9.82),
    "dot's null, cycles per mm": (1.22 / (DOT_PX * 5.04e-3), 24.6),
    "ring at the pupil, mm": (PAPER.ring_at_pupil_mm(9.5), 7.125),
    "iris at the eye, mm": (PAPER.iris_at_eye_mm, 2.4),
    "cone of an LED for 33 deg": (PAPER.led_cone_deg(33), 24.75),
    "ring that no reflex shows, mm": (reflex_free_mm(16.7), 2.24),
    "sagittal radius, mm": (petzval_mm()[0], 15.06),
    "tangential radius, mm": (petzval_mm()[1], 6.83),
    "walk at 25 deg, mm": (beam_walk_mm(25), 3.29792),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_numbers(name: str) -> None:
    """OPTICS.md 5.1, to the digits that it gives."""
    value, golden = GOLDEN[name]
    assert value == pytest.approx(golden, rel=2e-3 if abs(golden) < 100 and golden == round(golden, 2) else 2e-5)


@pytest.mark.parametrize(
    ("angle_deg", "left"), [(15, 1), (25, 1), (26, 0.969), (27, 0.823), (28, 0.624), (29, 0.400), (30, 0.180)]
)
def test_the_iris_overlap_of_a_walking_beam(angle_deg: float, left: float) -> None:
    """The table of OPTICS.md 6.3."""
    assert iris_overlap(beam_walk_mm(angle_deg), 7.7 / 2 * 4 / 3, 1.6) == pytest.approx(left, abs=0.001)


@pytest.mark.parametrize(
    ("field", "h_mm", "s_mm", "extent_mm"),
    [
        (33.4, 15.001, 1.3116, 5.823),
        (45, 20.711, 1.7671, 6.734),
        (48.3, 22.418, 1.8967, 6.993),
        (51.2, 23.956, 2.0106, 7.221),
    ],
)
def test_the_extent_table(field: float, h_mm: float, s_mm: float, extent_mm: float) -> None:
    """OPTICS.md 1.2."""
    assert size_mm(field) == pytest.approx(h_mm, abs=6e-4)
    assert field_extent.half_shift_mm(PAPER, field) == pytest.approx(s_mm, abs=6e-5)
    assert field_extent.extent_mm(PAPER, field) == pytest.approx(extent_mm, abs=6e-4)
    assert field_extent.half_shift_tan_mm(PAPER, field) > field_extent.half_shift_mm(PAPER, field)


def test_the_papers_own_sensor_breaks_its_rule_on_the_short_side() -> None:
    long_mm, short_mm = known_sensors()["quantalux"].size_mm
    assert field_extent.extent_mm(PAPER, 50) < long_mm
    assert field_extent.extent_mm(PAPER, 33.4) > short_mm


@pytest.mark.parametrize(
    ("name", "long_deg", "short_deg"),
    [("quantalux", 82.5, 28.6), ("imx296", 23.2, 7.0), ("imx477", 39.3, 19.3), ("ov2311", 20.4, 8.9)],
)
def test_the_field_table_of_the_sensors(name: str, long_deg: float, short_deg: float) -> None:
    """OPTICS.md 1.5, strict rule; the table rounds the sensors' sides to 0.01 mm."""
    fields = [field_extent.strict_field_deg(PAPER, side_mm) for side_mm in known_sensors()[name].size_mm]
    assert fields == pytest.approx([long_deg, short_deg], abs=0.15)


@pytest.mark.parametrize(
    ("name", "field", "share"),
    [("quantalux", 33.4, 0.98), ("quantalux", 45, 0.86), ("imx296", 33.4, 0.72), ("imx296", 45, 0.54)],
)
def test_the_captured_share_on_the_short_side(name: str, field: float, share: float) -> None:
    assert field_extent.captured_share(PAPER, field, known_sensors()[name].size_mm[1]) == pytest.approx(
        share, abs=0.006
    )


@given(st.floats(0, 8), st.floats(1.7, 6), st.floats(0.2, 1.6))
def test_an_overlap_is_a_share_and_falls_with_the_distance(shift: float, beam: float, iris: float) -> None:
    share = iris_overlap(shift, beam, iris)
    assert -1e-9 <= share <= 1 + 1e-9
    assert iris_overlap(shift + 0.1, beam, iris) <= share + 1e-9


@given(st.floats(1, 100))
def test_field_and_size_are_inverse_functions(field: float) -> None:
    assert field_deg(size_mm(field)) == pytest.approx(field)


def test_the_small_angle_limit_of_the_field() -> None:
    assert radians(field_deg(0.025)) == pytest.approx(0.025 / 25, rel=1e-6)
    assert degrees(0.001) == pytest.approx(field_deg(0.025), rel=1e-6)
