"""Optical budget against the independently computed tables of OPTICS.md 1.2, 1.4, 1.5 and 4.2."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.config.head_file import load_head
from device.config.sensors import known_sensors
from device.optics.budget import Design, OpticalBudget, design_of_head, design_of_sensor, optical_budget
from device.optics.eye import Relay, beam_walk_mm, iris_overlap
from device.optics.field_extent import captured_share
from device.optics.illumination import half_period_deg
from device.optics.light_path import load_light_path

HARDWARE = Path(__file__).parents[2] / "hardware"
PATH = load_light_path(HARDWARE / "optics.toml")
ROUNDED_MM = 0.0051  # rounding of the table's sides, which changes a field by 1 / (a z) rad/mm


def behind(sensor: str, **other: object) -> Design:
    return replace(design_of_sensor(PATH, known_sensors()[sensor]), **other)  # type: ignore[arg-type]


def at_field(field_deg: float, sensor: str = "quantalux") -> OpticalBudget:
    return optical_budget(behind(sensor, optics=PATH.optics.model_copy(update={"field_deg": field_deg})))


@pytest.mark.parametrize(
    ("field", "h_mm", "s_mm", "extent_mm", "px", "ideal_mm"),
    [
        (33.4, 15.001, 1.3116, 5.823, 1155, 5.900),
        (45, 20.711, 1.7671, 6.734, 1336, 6.928),
        (48.3, 22.418, 1.8967, 6.993, 1388, 7.235),
        (50, 23.315, 1.9635, 7.127, 1414, 7.397),
        (51.2, 23.956, 2.0106, 7.221, 1433, 7.512),
    ],
)
def test_the_extent_table(field: float, h_mm: float, s_mm: float, extent_mm: float, px: int, ideal_mm: float) -> None:
    """OPTICS.md 1.2, every row and column; the object stands behind the model eye of 25 mm."""
    found = at_field(field)
    eye = replace(behind("quantalux"), eye_mm=25.0, optics=PATH.optics.model_copy(update={"field_deg": field}))
    assert optical_budget(eye).retina_mm == pytest.approx(h_mm, abs=6e-4)
    assert found.half_shift_mm == pytest.approx(s_mm, abs=6e-5)
    assert found.extent_mm == pytest.approx(extent_mm, abs=6e-4)
    assert round(found.extent_mm * 1000 / 5.04) == px
    assert found.extent_tan_mm == pytest.approx(ideal_mm, abs=6e-4)


TABLE = {  # OPTICS.md 1.5: px/deg, um/px, strict field long/short for d = 3.2, z = 6; for 1.6, 6; for 1.6, 4
    "quantalux": (15.6, 19.0, (82.5, 28.6), (102.8, 48.9), (154, 73)),
    "imx296": (22.8, 13.0, (23.2, 7.0), (43.6, 27.4), (65, 41)),
    "imx477": (50.7, 5.9, (39.3, 19.3), (59.7, 39.6), (89, 59)),
    "imx500": (50.7, 5.9, (39.3, 19.3), (59.7, 39.6), (89, 59)),
    "imx283": (32.7, 9.1, (127, 72), (148, 92), None),
    "imx585": (27.1, 11.0, (102, 39.8), (122, 60), (183, 90)),
    "imx708": (56.1, 5.3, (41.4, 5.5), (61.8, 25.8), (93, 39)),
    "imx519": (64.4, 4.6, (31.6, 13.6), (52, 33.9), (78, 51)),
    "ov2311": (26.2, 11.3, (20.4, 8.9), (40.7, 29.3), (61, 44)),
    "ar0234": (26.2, 11.3, (32.6, 5.1), (53, 25.5), (80, 38)),
    "ov9281": (26.2, 11.3, (8.1, 0), (28.5, 10.2), (43, 15)),
    "imx219": (70.1, 4.2, (6.0, 0), (26.4, 14.8), (40, 22)),
}


@pytest.mark.parametrize("name", TABLE)
def test_the_field_table(name: str) -> None:
    """OPTICS.md 1.5, every sensor; the last digit is uncertain by the rounding of the sides."""
    px_per_deg, um_per_px, *fields = TABLE[name]
    for (iris_um, distance_um), golden in zip(((3200, 6000), (1600, 6000), (1600, 4000)), fields, strict=True):
        optics = PATH.optics.model_copy(update={"iris_um": iris_um, "diffuser_to_sensor_um": distance_um})
        found = optical_budget(behind(name, optics=optics))
        if distance_um == 6000:
            assert found.px_per_deg == pytest.approx(px_per_deg, abs=0.06)
            assert found.retina_um_per_px == pytest.approx(um_per_px, abs=0.06)
        rounded_deg = 57.3 * ROUNDED_MM / (0.75 * distance_um / 1000)
        for side, tabulated_deg in zip((found.long, found.short), golden or (), strict=False):
            digit = 0.51 if isinstance(tabulated_deg, int) else 0.06
            assert side.strict_field_deg == pytest.approx(tabulated_deg, abs=digit + rounded_deg)


@pytest.mark.parametrize(
    ("name", "field", "share"),
    [
        ("imx296", 33.4, 0.72),
        ("imx296", 45, 0.54),
        ("quantalux", 33.4, 0.98),
        ("quantalux", 45, 0.86),
        ("imx477", 33.4, 0.88),
        ("imx477", 45, 0.73),
        ("ov9281", 33.4, 0.46),
        ("ov9281", 45, 0.28),
    ],
)
def test_the_captured_share_on_the_short_side(name: str, field: float, share: float) -> None:
    assert at_field(field, name).short.captured == pytest.approx(share, abs=0.006)


@pytest.mark.parametrize("name", TABLE)
def test_the_half_caught_field_captures_half(name: str) -> None:
    side = optical_budget(behind(name)).short
    assert captured_share(Relay(), side.half_caught_field_deg, side.sensor_mm) == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize(
    ("pupil_mm", "iris_um", "margin_mm", "half_field_deg"),
    [
        (3, 3200, 0.40, 12.6),
        (4, 3200, 1.07, 17.4),
        (3, 1600, 1.20, 18.1),
        (4, 1600, 1.87, 20.9),
        (5, 3200, 1.73, 20.4),
        (7.7, 3200, 3.53, 25.6),
        (5, 1600, 2.53, 23.0),
        (7.7, 1600, 4.33, 27.2),
    ],
)
def test_the_margin_of_a_pupil(pupil_mm: float, iris_um: float, margin_mm: float, half_field_deg: float) -> None:
    """OPTICS.md 1.4."""
    optics = PATH.optics.model_copy(update={"iris_um": iris_um})
    found = optical_budget(behind("quantalux", optics=optics, pupil_mm=pupil_mm))
    assert found.pupil_margin_mm == pytest.approx(margin_mm, abs=0.006)
    assert found.filled_field_deg / 2 == pytest.approx(half_field_deg, abs=0.06)


@given(st.floats(2.5, 9), st.floats(0.5, 3.2))
def test_within_the_filled_field_nothing_clips_and_beyond_it_does(pupil_mm: float, iris_mm: float) -> None:
    """Against the overlap of the two discs, an independent formula."""
    relay = Relay(iris_mm=iris_mm)
    half_deg, beam_mm = relay.filled_field_deg(pupil_mm) / 2, relay.beam_at_iris_mm(pupil_mm) / 2
    assert iris_overlap(beam_walk_mm(half_deg - 0.01), beam_mm, iris_mm / 2) == 1
    assert iris_overlap(beam_walk_mm(half_deg + 0.5), beam_mm, iris_mm / 2) < 1


def test_a_pupil_smaller_than_the_iris_never_fills_it() -> None:
    found = optical_budget(behind("quantalux", pupil_mm=2.3))
    assert found.pupil_margin_mm < 0
    assert found.filled_field_deg == 0


def test_the_papers_ring_and_ours_in_the_pupil() -> None:
    """Ours is 10.04 mm (hardware/decisions/); the paper's LEDs lie 4.24 and 5.10 mm off the axis of a 2 mm grid."""
    ours = optical_budget(behind("imx296"))
    papers = optical_budget(design_of_head(PATH, load_head(HARDWARE / "heads" / "paper.toml")))
    assert (ours.leds, papers.leds) == (8, 12)
    assert ours.ring_at_pupil_mm == ours.inner_ring_at_pupil_mm == pytest.approx(10.04 * 0.75, abs=0.01)
    assert papers.inner_ring_at_pupil_mm == pytest.approx(2 * 4.243 * 0.75, abs=0.01)
    assert ours.reflex_free_mm == pytest.approx(2.24, abs=0.005)


def test_a_head_with_a_pupil_uses_that_pupil_and_its_ring() -> None:
    """The next clean ring inside of 10.04 mm is that of the four inner LEDs, 3.37 mm at the pupil: in the reflex."""
    head = load_head(HARDWARE / "heads" / "imx296.toml")
    small = head.model_copy(update={"light": head.light.model_copy(update={"pupil_mm": 7.0})})
    design = design_of_head(PATH, small)
    found = optical_budget(design)
    assert design.pupil_mm == 7.0
    assert found.leds == 4
    assert found.ring_at_pupil_mm == pytest.approx(3.175 * 2**0.5 * 0.75, abs=0.001)
    assert found.ring_at_pupil_mm / 2 < found.reflex_free_mm


def test_the_light_of_the_papers_ring() -> None:
    """OPTICS.md 4.2, green, within the 9 % by which its cone differs from the field's area."""
    found = optical_budget(design_of_head(PATH, load_head(HARDWARE / "heads" / "paper.toml")))
    assert found.light.cornea_mw == pytest.approx(0.210, rel=0.01)
    inside = design_of_head(PATH, load_head(HARDWARE / "heads" / "paper.toml")).share_in_pupil
    assert 0.7 < inside < 0.8, "the edge of 7.7 mm cuts the outer LEDs; OPTICS.md 4.2 has the whole ring"
    assert found.light.retina_mw_per_cm2 == pytest.approx(0.257 * inside, rel=0.01)
    assert found.electrons_per_px == pytest.approx(420 * inside, rel=0.1)
    assert not found.within_simulated_range


@pytest.mark.parametrize(("electrons", "um"), [(2e3, 244), (20e3, 137), (100e3, 104)])
def test_the_half_periods_that_were_simulated(electrons: float, um: float) -> None:
    """OPTICS.md 4.3, on a retina behind 17 mm: 0.2967 mm per degree."""
    assert half_period_deg(electrons, 5.04) * 296.7 == pytest.approx(um, rel=1e-3)
    assert half_period_deg(electrons / 4, 2.52) == pytest.approx(half_period_deg(electrons, 5.04))


@given(st.floats(10, 1e6), st.floats(1.01, 10))
def test_more_light_resolves_more(electrons: float, times: float) -> None:
    assert half_period_deg(electrons * times, 5.04) < half_period_deg(electrons, 5.04)


def test_clear_apertures_of_first_lens_and_splitter() -> None:
    """37.5 mm behind the pupil the edge of 50 degrees stands 17.49 mm off the axis, and its beam is 2.4 mm wide."""
    assert at_field(50).first_lens_mm == pytest.approx(2 * 17.486 + 2.4, abs=0.01)
    assert at_field(50).splitter_mm == pytest.approx(2 * 25 * 0.75 * 0.46631 + 3.2, abs=0.01)
