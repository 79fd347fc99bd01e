"""Tests of the light hazard: figures of the photon budget, limits, and damaged limit files."""

from math import exp, log, sqrt
from pathlib import Path

import pytest

from device.config.radiometry import BeamSpec, RadiometrySpec
from device.errors import LightLimit, SpecError
from device.light_safety.hazard import LIMITS, Beam, Hazard, light_limits, radiometry, worst_beam
from device.values import Colour, Illumination

# All twelve LEDs at full drive through the paper's optics; retinal irradiance in W/cm2.
TABLE = {"red": Beam(0.622, 0.301e-3, 1e-3), "green": Beam(0.522, 0.257e-3, 1e-3), "blue": Beam(0.467, 0.635e-3, 1e-3)}
EVERY_COLOUR: tuple[Colour, ...] = ("red", "green", "blue")


@pytest.fixture
def hazard() -> Hazard:
    return Hazard(TABLE, light_limits())


def test_limits_are_the_chosen_shares_of_group_1() -> None:
    limits = light_limits()
    assert limits.photochemical_w_per_cm2 == pytest.approx(110e-6)
    assert limits.photochemical_dose.limit == pytest.approx(220e-6 * 7200)  # two hours of Group 1
    assert limits.stop_j_per_cm2 == pytest.approx(0.1584)
    assert limits.stop_without_visit_j_per_cm2 == pytest.approx(0.0792)
    assert limits.warn_j_per_cm2 == pytest.approx(0.0792)
    assert limits.thermal_w_per_cm2 == pytest.approx(0.07)
    assert limits.waist_w_per_cm2 == pytest.approx(0.4)
    assert limits.window_s == 86400


def test_no_limit_is_marked_as_checked_yet() -> None:
    """Update this test together with `checked`, after comparison with the purchased standard."""
    limits = light_limits()
    assert set(limits.unchecked) == set(type(limits).model_fields)


# Between 465 nm (0.70) and 470 nm (0.62) the weight of 467 nm depends on the interpolation: 1.5 %.
@pytest.mark.parametrize(
    ("colour", "uw_per_cm2", "seconds"), [("red", 0.30, 5.3e5), ("green", 9.3, 1.7e4), ("blue", 419, 378)]
)
def test_the_photochemical_figures_of_the_budget(
    hazard: Hazard, colour: str, uw_per_cm2: float, seconds: float
) -> None:
    illumination = Illumination(colour)
    assert hazard.photochemical_w_per_cm2(illumination) * 1e6 == pytest.approx(uw_per_cm2, rel=0.015)
    assert hazard.limits.stop_j_per_cm2 / hazard.photochemical_w_per_cm2(illumination) == pytest.approx(
        seconds, rel=0.015
    )
    assert hazard.dose_j_per_cm2(illumination, seconds) == pytest.approx(0.1584, rel=0.015)


def test_ten_flashes_of_each_colour_are_0_05_percent_of_the_daily_dose(hazard: Hazard) -> None:
    total = sum(10 * hazard.dose_j_per_cm2(Illumination(colour), 0.2) for colour in TABLE)
    assert total == pytest.approx(0.86e-3, rel=0.015)
    assert total / hazard.limits.photochemical_dose.limit == pytest.approx(0.0005, rel=0.1)


def test_weights_are_interpolated_logarithmically(hazard: Hazard) -> None:
    weight = hazard.limits.photochemical_weight
    assert weight.at(0.440) == pytest.approx(1)
    for nm in (500, 522, 550, 600):
        assert weight.at(nm / 1000) == pytest.approx(10 ** ((450 - nm) / 50))
    assert weight.at(0.65) == pytest.approx(0.001)
    assert 0.62 < weight.at(0.467) < 0.70
    for nm in (399, 701, 850):
        with pytest.raises(SpecError, match="no weight"):
            weight.at(nm / 1000)


def test_blue_at_full_drive_is_refused_with_the_permitted_level(hazard: Hazard) -> None:
    with pytest.raises(LightLimit, match=r"3\.85 times") as caught:
        hazard.refuse(Illumination("blue"))
    assert "25.9 %" in caught.value.remedy
    hazard.refuse(Illumination("blue", 0.25))
    for colour in ("red", "green"):
        hazard.refuse(Illumination(colour))


@pytest.mark.parametrize("beam", [Beam(0.622, 0.0701, 1e-3), Beam(0.622, 1e-3, 0.401)], ids=["retina", "waist"])
def test_thermal_and_waist_limits_are_enforced(beam: Beam) -> None:
    hazard = Hazard({"red": beam}, light_limits())
    with pytest.raises(LightLimit):
        hazard.refuse(Illumination("red"))
    hazard.refuse(Illumination("red", 0.99))


def test_an_unmeasured_colour_has_worst_case_radiometry() -> None:
    worst = radiometry()
    for colour, beam in TABLE.items():
        through_nothing = 2 / (0.42 * 0.5 * 0.9)  # lossless optics, LEDs twice as bright as estimated
        assert worst[colour].retina_w_per_cm2 == pytest.approx(through_nothing * beam.retina_w_per_cm2, rel=0.01)
        assert worst[colour].waist_w_per_cm2 < 0.1
    assert worst_beam("red", leds=24).retina_w_per_cm2 == pytest.approx(2 * worst["red"].retina_w_per_cm2)
    assert worst_beam("red", field_deg=20).retina_w_per_cm2 > 2 * worst["red"].retina_w_per_cm2


def test_weight_of_a_spectrum_is_its_mean() -> None:
    """Where A(lambda) is 10^((450 - lambda) / 50), a Gaussian weighs exp((sigma ln 10 / 50)^2 / 2) times its peak."""
    weight = light_limits().photochemical_weight
    sigma_nm = 10 / sqrt(8 * log(2))
    mean = weight.at(0.55) * exp((sigma_nm * log(10) / 50) ** 2 / 2)
    assert weight.of_spectrum(0.55, 0.01) == pytest.approx(mean, rel=1e-4)
    assert weight.of_spectrum(0.55, 0) == weight.at(0.55)
    assert weight.of_spectrum(0.525, 0.035) > 1.26 * weight.at(0.525), "below 500 nm it grows faster"
    assert weight.of_spectrum(0.40, 0.035) < weight.at(0.40), "nothing below the table"


def test_a_measured_colour_has_its_guard_factor_and_others_the_worst_case() -> None:
    green = BeamSpec(wavelength_um=0.53, retina_mw_per_cm2=0.2, waist_mw_per_cm2=3)
    found = radiometry(RadiometrySpec(measured="power meter, 2026-11", guard_factor=1.5, green=green))
    assert found["green"] == Beam(0.53, pytest.approx(0.3e-3), pytest.approx(4.5e-3), 0.035)
    assert found["red"] == worst_beam("red")


@pytest.mark.parametrize(
    ("original", "replacement"),
    [
        ("limit = 220.0", ""),
        ("limit = 220.0", "limit = -1"),
        ("uW/cm2", "mW/cm2"),
        ("\nchecked = false", ""),
        ("share = 0.10", "share = 10"),
        ("[thermal_irradiance]", "[thermal"),
        ("1.43, ", ""),
        ("window_h = 24.0", "window_h = 2"),
        ("share_without_visit = 0.05", "share_without_visit = 0.10"),
        ("[waist_irradiance]", "[waste_irradiance]"),
        ("share = 0.5 ", "share = 0.6 "),
        ("\nchecked = false", "\nchecked = true"),
        ("\nchecked = false", '\nchecked = false\nchecked_by = "A. Lovelace"'),
    ],
)
def test_a_damaged_limits_file_raises_spec_error(tmp_path: Path, original: str, replacement: str) -> None:
    text = LIMITS.read_text(encoding="utf-8")
    assert original in text
    path = tmp_path / "limits.toml"
    path.write_text(text.replace(original, replacement, 1), encoding="utf-8")
    with pytest.raises(SpecError):
        light_limits(path)


def test_a_missing_limits_file_raises_spec_error(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="cannot be read"):
        light_limits(tmp_path / "limits.toml")


def test_the_highest_level_of_a_colour_is_permitted_and_a_higher_one_is_not(hazard: Hazard) -> None:
    for colour in EVERY_COLOUR:
        level = hazard.highest_level(colour)
        hazard.refuse(Illumination(colour, level))
        if level < 1:
            with pytest.raises(LightLimit):
                hazard.refuse(Illumination(colour, level + 0.001))
    assert hazard.highest_level("blue") < 1, "full drive is above the limit"
    assert hazard.highest_level("red") == 1
