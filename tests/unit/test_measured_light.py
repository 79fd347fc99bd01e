"""`diffuscope light`: a reading decides go or no go as the guard does, and one that cannot be right is refused."""

from dataclasses import replace
from math import exp, log, pi
from pathlib import Path
from statistics import NormalDist

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from device.config.head_file import InstrumentSpec, load_head
from device.errors import LightLimit, SettingError, SpecError
from device.head import hazard_of
from device.light_safety.hazard import light_limits
from device.optics.light_budget import chain, log_sd, product
from device.values import Illumination
from services.cli import app
from services.workshop.light_report import at_full_drive, expected_beam, expected_uw, limit_shares
from services.workshop.measured_light import (
    MeteredLight,
    MeterReading,
    in_colour,
    judge,
    words,
)
from services.workshop.optics_report import design_of

HEADS = Path(__file__).parents[2] / "hardware" / "heads"
POWER = HEADS / "imx296_power.toml"
SPEC = load_head(POWER)
READING = MeterReading("green", 9.0, 43.0, 525.0, "meter X, 2026-11-25")


def judged(reading: MeterReading = READING, spec: InstrumentSpec = SPEC) -> MeteredLight:
    return judge(spec, design_of(spec), reading, light_limits())


def test_the_expected_light_is_a_go_and_twice_as_much_is_none() -> None:
    assert judged().is_go
    bright = judged(replace(READING, axis_uw=18, waist_mw_per_cm2=86))
    assert not bright.is_go
    assert 0.5 < bright.permitted_level < 1


@pytest.mark.parametrize("name", ["imx296", "imx296_power"])
def test_budget_and_command_give_one_share_of_the_limit(name: str) -> None:
    """The budget's own power behind the hole on the axis, as a reading, has the budget's share: of the worst eye."""
    spec = load_head(HEADS / f"{name}.toml")
    design = design_of(spec)
    expected = limit_shares(design, expected_beam(design), light_limits())
    reading = MeterReading("green", expected_uw(design), 1.0, 1000 * design.led.wavelength_um, "x")
    found = judge(spec, design, reading, light_limits())
    assert [share.used for share in found.shares[:2]] == pytest.approx([share.used for share in expected[:2]])
    assert found.is_go == (expected[0].used <= 1)


def test_share_of_no_go_is_that_of_the_normal_distribution() -> None:
    """Of ln: LED, polariser, splitter and relay of the chain, and the wavelength in the LEDs' bin."""
    design = design_of(SPEC)
    used = limit_shares(design, expected_beam(design), light_limits())[0].used
    sd = (0.35**2 + 0.1**2 + 0.05**2 + 0.03**2 + 0.2**2) ** 0.5
    found = at_full_drive(design)
    assert found.no_go == pytest.approx(NormalDist().cdf(log(used) / sd), abs=0.015)  # four sigma of 20 000 draws
    assert found.share.low == pytest.approx(used * exp(-1.645 * sd), rel=0.03)
    assert found.electrons.median < product(chain(design))


def test_a_measured_ring_is_the_budget_of_its_head() -> None:
    """Half of the expected power, as a reading, halves the electrons; limits and spread are those of the reading."""
    design = design_of(SPEC)
    found = judge(SPEC, design, replace(READING, axis_uw=expected_uw(design) / 2, waist_mw_per_cm2=20), light_limits())
    light = SPEC.light.model_copy(update={"radiometry": found.radiometry})
    measured = design_of(SPEC.model_copy(update={"light": light}))
    assert product(chain(measured)) == pytest.approx(product(chain(design)) / 2)
    assert limit_shares(measured, expected_beam(measured), light_limits()) == found.shares
    assert log_sd(chain(measured)) < log_sd(chain(design)) - 0.05
    assert any(READING.meter in factor.source for factor in chain(measured))


def test_a_wider_spectrum_uses_more_of_the_limit() -> None:
    narrow, wide = (judged(replace(READING, fwhm_nm=nm)).shares[0].used for nm in (0, 35))
    assert wide / narrow == pytest.approx(1.32, abs=0.005)


@given(st.floats(0.4, 80), st.sampled_from([1.3, 2.0]))
def test_the_guard_of_the_head_decides_as_the_command(axis_uw: float, guard_factor: float) -> None:
    found = judged(replace(READING, axis_uw=axis_uw, waist_mw_per_cm2=4 * axis_uw, guard_factor=guard_factor))
    light = SPEC.light.model_copy(update={"radiometry": found.radiometry})
    hazard = hazard_of(SPEC.model_copy(update={"light": light}))
    hazard.refuse(Illumination("green", found.permitted_level))
    if not found.is_go:
        with pytest.raises(LightLimit):
            hazard.refuse(Illumination("green"))


def test_the_printed_lines_are_a_table_of_the_head_file(tmp_path: Path) -> None:
    found = judged()
    lines = words(READING, found).partition("\n\n")[2]
    (head := tmp_path / "head.toml").write_text(f"{POWER.read_text()}\n{lines}\n")
    read = load_head(head).light.radiometry
    assert read is not None
    assert read.green is not None
    assert read.amber is None
    assert read.green.retina_mw_per_cm2 == pytest.approx(found.radiometry.green.retina_mw_per_cm2, rel=1e-3)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"axis_uw": 0.005}, "expected"),
        ({"axis_uw": 1300.0}, "expected"),
        ({"waist_mw_per_cm2": 4000.0}, "more than the 1.2 mW"),
        ({"peak_nm": 620.0}, "not that of LEDs of 525 nm"),
    ],
)
def test_a_reading_that_cannot_be_right_is_refused(changes: dict[str, float], says: str) -> None:
    with pytest.raises(SettingError, match=says):
        judged(replace(READING, **changes))  # type: ignore[arg-type]


def test_another_colour_is_judged_as_that_of_its_leds() -> None:
    amber = in_colour(SPEC, "amber")
    assert judged(MeterReading("amber", 2.0, 12.0, 590.0, "x"), amber).is_go
    with pytest.raises(SettingError, match="no colour"):
        in_colour(SPEC, "infrared")
    with pytest.raises(SpecError, match="no blue LEDs"):
        design_of(in_colour(SPEC, "blue"))


def test_the_command_fails_for_no_go() -> None:
    base = ["light", "--head", str(POWER), "--waist-mw-per-cm2", "43", "--peak-nm", "525", "--meter", "x"]
    go, no_go = (CliRunner().invoke(app, [*base, "--axis-uw", power]) for power in ("9", "28"))
    assert (go.exit_code, no_go.exit_code) == (0, 1)
    assert "GO: full drive" in go.stdout
    assert "NO GO" in no_go.stdout


def test_the_expected_power_on_the_axis_is_that_of_lambertian_leds() -> None:
    """Four of 30 mW: power over pi on an LED's axis, widened by the relay, through 5 mm at 100 mm."""
    on_axis_mw_per_sr = 4 * 30 / pi * 0.42 * 0.5 * 0.9 * 0.75**2
    design = design_of(SPEC)
    assert expected_uw(design) == pytest.approx(1000 * on_axis_mw_per_sr * pi * (2.5 / 100) ** 2)
    assert expected_uw(replace(design, pupil_mm=7.0)) == expected_uw(design), "it does not depend on an eye's pupil"
    assert design.highest_mw_per_cm2 == pytest.approx(on_axis_mw_per_sr / 1.7**2), "E = I / f^2"


def test_a_colour_that_the_ring_does_not_have_is_refused() -> None:
    with pytest.raises(SpecError, match="has no amber LEDs"):
        in_colour(load_head(HEADS / "imx296.toml"), "amber")
    with pytest.raises(SettingError, match="no colour is called 'mauve'"):
        in_colour(load_head(HEADS / "imx296.toml"), "mauve")
