"""Light budget: the chain is the photon budget taken apart, and no head of the search exceeds a limit."""

import re
from dataclasses import replace
from math import exp, radians, sin
from pathlib import Path

import pytest

from device.config.head_file import InstrumentSpec, SinkSpec, load_head
from device.config.radiometry import LED_FWHM_UM
from device.errors import LightLimit, SettingError
from device.head import hazard_of
from device.light_safety.hazard import Hazard, light_limits
from device.optics.budget import Design, design_of_head, optical_budget
from device.optics.illumination import LED, led_at, photon_budget
from device.optics.light_budget import (
    CELL_UM,
    ENOUGH_E,
    chain,
    cornea_mw,
    log_sd,
    possible_gains,
    product,
    retina_mw_per_cm2,
    simulated,
)
from device.optics.light_path import load_light_path
from device.optics.matrix import ring, share_in_pupil
from device.values import Colour, Illumination
from services.workshop import head_search, light_report
from services.workshop.light_report import at_full_drive, expected_beam, half_period_um
from services.workshop.optics_report import widest_iris_mm
from tests.project_files import text

HARDWARE = Path(__file__).parents[2] / "hardware"
PATH = load_light_path(HARDWARE / "optics.toml")
SIMULATED = set((HARDWARE / "heads").glob("sim_*.toml"))  # with the light of their namesakes
HEADS = sorted(path for path in {*(HARDWARE / "heads").glob("*.toml")} - SIMULATED if load_head(path).optics)


def head(name: str) -> InstrumentSpec:
    return load_head(HARDWARE / "heads" / f"{name}.toml")


def sinks(name: str) -> SinkSpec:
    found = head(name).light.sinks
    assert found is not None
    return found


def design(name: str) -> Design:
    return design_of_head(PATH, head(name))


@pytest.mark.parametrize("path", HEADS, ids=lambda path: path.stem)
def test_the_chain_is_the_photon_budget_times_the_share_in_the_pupil(path: Path) -> None:
    chosen = design_of_head(PATH, load_head(path))
    budget = optical_budget(chosen)
    inside = share_in_pupil(chosen.chain, 0.75, chosen.emitter_mm, chosen.pupil_mm)
    leds = len(ring(chosen.chain))
    whole = photon_budget("green", chosen.pitch_um, 33.4, chosen.eye_mm, chosen.relay, leds, chosen.led)
    cell = whole.electrons_per_px_s * chosen.exposure_s * (CELL_UM / chosen.pitch_um) ** 2
    assert budget.electrons_per_px == pytest.approx(inside * whole.electrons_per_px_s * chosen.exposure_s)
    assert budget.light.cornea_mw == whole.cornea_mw
    assert product(chain(chosen)) == pytest.approx(cell * inside, rel=1e-9)
    assert product(chain(chosen, 0.5, 4)) == pytest.approx(2 * cell * inside, rel=1e-9)
    assert retina_mw_per_cm2(chain(chosen)) == pytest.approx(whole.retina_mw_per_cm2 * inside, rel=1e-9)


def test_the_monte_carlo_has_the_quantiles_of_a_log_normal_product() -> None:
    factors = chain(design("imx296"))
    sd, found = log_sd(factors), simulated(factors)
    # The error of a quantile of 20 000 draws is 0.02 sd; five times that.
    assert found.median == pytest.approx(product(factors), rel=0.1 * sd)
    assert found.low == pytest.approx(product(factors) * exp(-1.645 * sd), rel=0.1 * sd)
    assert found.high == pytest.approx(product(factors) * exp(1.645 * sd), rel=0.1 * sd)


def test_response_goes_through_the_known_leds() -> None:
    for led in LED.values():
        between = led_at(led.wavelength_um, 1.0)
        assert between.reflectance == pytest.approx(led.reflectance)
        assert between.quantum_efficiency == pytest.approx(led.quantum_efficiency)
    assert LED["green"].reflectance < led_at(0.56, 1.0).reflectance < led_at(0.59, 1.0).reflectance


def test_a_pupil_cuts_the_image_of_the_ring() -> None:
    ring = design("imx296_power").chain
    shares = [share_in_pupil(ring, 0.75, 1.0, pupil_mm) for pupil_mm in (9.0, 7.7, 7.0, 5.0)]
    assert shares[0] == 1.0
    assert shares[-1] == 0.0
    assert shares == sorted(shares, reverse=True)


@pytest.mark.parametrize("name", ["imx296", "imx296_power"])
def test_the_guard_permits_the_level_of_the_report_and_no_more(name: str) -> None:
    chosen, limits = design(name), light_limits()
    for beam in (light_report.unmeasured_beam(chosen), light_report.expected_beam(chosen)):
        level = light_report.permitted_level(light_report.limit_shares(chosen, beam, limits))
        hazard = Hazard({"green": beam}, limits)
        hazard.refuse(Illumination("green", level))
        if level < 1:
            with pytest.raises(LightLimit):
                hazard.refuse(Illumination("green", level + 0.002))


def test_the_guard_takes_the_power_of_the_heads_own_leds() -> None:
    """An unmeasured high-power ring must not count as one of APA102: it would be permitted at full drive."""
    spec = head("imx296_power")
    hazard = hazard_of(spec)
    assert hazard.beams["green"] == light_report.unmeasured_beam(design("imx296_power"))
    colours: tuple[Colour, ...] = ("green", "amber")
    for colour in colours:
        lamp = sinks("imx296_power").colours[colour]
        per_led = hazard_of(head("imx296")).beams["green"].waist_w_per_cm2 / LED["green"].power_mw
        assert hazard.beams[colour].waist_w_per_cm2 == pytest.approx(per_led * lamp.power_mw)
    with pytest.raises(LightLimit):
        hazard.refuse(Illumination("green"))
    with pytest.raises(LightLimit, match="no blue LEDs"):
        hazard.refuse(Illumination("blue", 0.01))


def test_the_chosen_head_has_enough_light_within_every_limit() -> None:
    chosen = design("imx296_power")
    shares = light_report.limit_shares(chosen, light_report.expected_beam(chosen), light_limits())
    level = light_report.permitted_level(shares)
    assert product(chain(chosen, level)) >= ENOUGH_E > product(chain(design("imx296")))
    assert max(share.used for share in shares) * level <= 1
    assert level == 1, "a picture needs full drive"
    assert light_report.at_full_drive(chosen).no_go < 0.2
    ring = sinks("imx296_power")
    assert ring.most_ma <= head_search.SUPPLY_MA
    drawn_ma = ring.output_ma * len(ring.colours["green"].outputs[0])
    powers = [
        choice.led.power_mw
        for choice in head_search.CHOICES
        if (choice.colour, choice.current_ma) == ("green", drawn_ma)
    ]
    assert powers == [ring.colours["green"].power_mw], "the search takes the head's LED at its current"


def test_the_search_exceeds_no_limit_and_ranks_enough_light_first() -> None:
    found = head_search.search(design("imx296"))
    assert max(candidate.largest_share for candidate in found) <= 1
    enough = [candidate.light_e >= ENOUGH_E for candidate in found]
    assert any(enough)
    assert enough == sorted(enough, reverse=True)
    assert all(candidate.leds * candidate.choice.current_ma <= head_search.SUPPLY_MA for candidate in found)


def test_the_search_leaves_out_an_iris_whose_caustic_the_sensor_does_not_hold() -> None:
    """The calibration wants a sixteenth of the sensor's side dark at each edge: 3.28 mm of the IMX296's 3.75."""
    small = design("imx296")
    assert widest_iris_mm(small) == pytest.approx(14 / 16 * 1088 * 3.45e-3)
    assert max(candidate.iris_um for candidate in head_search.search(small)) == 3200
    large = replace(small, rows=1456)
    assert max(candidate.iris_um for candidate in head_search.search(large)) == 4000


@pytest.mark.parametrize("name", ["imx296", "imx296_power"])
def test_a_pupil_that_passes_no_light_is_refused_with_a_remedy(name: str) -> None:
    chosen = replace(design(name), pupil_mm=6.0)
    for show in (light_report.table, light_report.gains_svg):
        with pytest.raises(SettingError, match="no light reaches the sensor: a pupil of 6 mm") as refused:
            show(chosen)
        begins_mm = float(re.findall(r"wider than ([\d.]+) mm", refused.value.remedy)[0])
        assert replace(chosen, pupil_mm=begins_mm - 0.01).share_in_pupil == 0
        show(replace(chosen, pupil_mm=begins_mm + 0.1))


def test_a_wider_field_has_a_wider_cone_in_budget_and_hazard() -> None:
    """50 degrees need the cone of 37.5: sin^2 of its half is 2.2 times that of 25 degrees."""
    spec = head("imx296_power")
    assert spec.optics is not None
    wide = spec.model_copy(update={"optics": spec.optics.model_copy(update={"field_deg": 50.0})})
    times = (sin(radians(50 * 0.375)) / sin(radians(12.5))) ** 2
    usual, more = (cornea_mw(chain(design_of_head(PATH, instrument))) for instrument in (spec, wide))
    assert more / usual == pytest.approx(times, rel=0.01)  # 12.5 degrees are 12.525, rounded by the paper
    waists = [hazard_of(instrument).beams["green"].waist_w_per_cm2 for instrument in (spec, wide)]
    assert waists[1] / waists[0] == pytest.approx(times, rel=0.01)
    narrow = spec.model_copy(update={"optics": spec.optics.model_copy(update={"field_deg": 20.0})})
    assert hazard_of(narrow).beams["green"].waist_w_per_cm2 == waists[0], "the cap of an unmeasured head may be another"


def test_the_chain_agrees_with_two_published_instruments() -> None:
    """OPTICS.md 4.6: 0.13 mJ/cm2 in about 1 s from 0.25 mW at 48 degrees; a phone's flash of 20 to 50 lm at 15 cm."""
    lit = replace(design("imx296"), optics=design("imx296").optics.model_copy(update={"field_deg": 48.0}))
    per_mw = next(factor.value for factor in chain(lit) if factor.name == "lit retina")
    assert 0.25 * per_mw == pytest.approx(0.13, rel=0.1)
    wide = replace(lit, optics=lit.optics.model_copy(update={"field_deg": 46.0}))
    into_lens = 0.025**2 / 0.15**2
    low, high = (
        1000 * lumens / 250 * into_lens * next(factor.value for factor in chain(wide) if factor.name == "lit retina")
        for lumens in (20, 50)
    )
    assert low < 1.40 < high


def test_documents_have_the_figures_of_the_chosen_head() -> None:
    chosen = design("imx296_power")
    built, shares = at_full_drive(chosen), light_report.limit_shares(chosen, expected_beam(chosen), light_limits())
    low, high = (f"{100 * share:.0f}" for share in (built.share.low, built.share.high))
    small = replace(chosen, pupil_mm=7.0)
    bound = simulated(chain(chosen))
    facts = {
        "electrons": f"{spaced(product(chain(chosen)))} electrons",
        "small pupil": f"{spaced(product(chain(small)))}",
        "within": f"{spaced(built.electrons.median)}",
        "no go": f"{100 * built.no_go:.0f} % of builds are NO GO",
        "share": f"{100 * shares[0].used:.0f} % of",
        "range": f"{low} to {high} %",
        "half-period": f"{half_period_um(chosen, built.electrons.median):.0f} (um )?instead of "
        f"{half_period_um(design('imx296'), product(chain(design('imx296')))):.0f} um",
    }
    decision = " ".join(text("hardware/decisions/0006-ring-of-high-power-leds.md").split())
    readme, optics = (" ".join(text(name).split()) for name in ("hardware/README.md", "device/optics/OPTICS.md"))
    for words in (readme, decision):
        assert [what for what, figure in facts.items() if not re.search(figure, words)] == []
    quantiles = [spaced(electrons) for electrons in (bound.low, bound.high, built.electrons.low, built.electrons.high)]
    for words in (readme, optics):
        assert "{} to {}".format(*quantiles[:2]) in words
        assert "{} to {}".format(*quantiles[2:]) in words
    row = f"| {spaced(product(chain(chosen)))} | {quantiles[0]} to {quantiles[1]} | {facts['small pupil']} | "
    assert f"{row}{half_period_um(chosen, product(chain(chosen))):.0f} um | {100 * shares[0].used:.0f} % | " in optics
    assert f"{100 * shares[2].used:.0f} % |" in optics.partition(row)[2][:40]
    assert f"a Gaussian of full width {1000 * LED_FWHM_UM:.0f} nm" in optics


@pytest.mark.parametrize("path", HEADS, ids=lambda path: path.stem)
def test_readme_has_the_electrons_of_a_smaller_pupil(path: Path) -> None:
    chosen = replace(design_of_head(PATH, load_head(path)), pupil_mm=7.0)
    mean_e = product(chain(chosen)) * (chosen.pitch_um / CELL_UM) ** 2
    assert re.search(rf"^\| `{path.name}` \| \d+ \| \d+ \| {mean_e:.0f} \|$", text("hardware/README.md"), re.M)


def spaced(electrons: float) -> str:
    """Return a number of electrons to ten, as the documents write it: 15 060."""
    return re.sub(r"^(\d\d)(\d{3})$", r"\1 \2", f"{round(electrons, -1):.0f}")


def test_gains_and_report_name_every_cause(tmp_path: Path) -> None:
    chosen = design("imx296_power")
    gains = possible_gains(chain(chosen))
    assert {"coupling", "pupil", "polarisers", "splitter", "pixel", "exposure", "safety"} == set(gains)
    assert min(gains.values()) >= 1
    words, drawn = light_report.table(chosen), light_report.gains_svg(chosen)
    assert all(factor.name in words for factor in chain(chosen))
    assert all(cause in drawn for cause, gain in gains.items() if gain > 1)
