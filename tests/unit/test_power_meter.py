"""`diffuscope meter`: pulses within the guard's limits, counted in the ledger, and a reading above a limit refused."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import LightLimit, SettingError, SpecError
from device.head import hazard_of
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import LIT_AFTER_KILL_S
from device.light_safety.hazard import light_limits
from device.values import EYES
from services.cli import app
from services.workshop.measured_light import MeterReading, in_colour, judge
from services.workshop.optics_report import design_of
from services.workshop.power_meter import judge_reading, pulse, run_of, words
from tests.project_files import text
from tests.simulated import small_head_toml

HEADS = Path(__file__).parents[2] / "hardware" / "heads"
POWER = load_head(HEADS / "imx296_power.toml")
SIM = InstrumentSpec.model_validate(tomllib.loads(small_head_toml("small")))


def test_an_unmeasured_ring_shines_no_brighter_than_the_guard_permits() -> None:
    run = run_of(POWER, None, 20)
    assert run.illumination.level == pytest.approx(0.252)
    assert run.count * run.on_s == pytest.approx(10, abs=run.on_s), "half of 20 s are lit"
    assert run.on_s < POWER.light.max_on_s
    with pytest.raises(LightLimit, match="brighter than an eye may see"):
        run_of(POWER, 0.26, 20)


def test_the_train_passes_the_guard_and_is_counted_for_both_eyes() -> None:
    """Two minutes of pulses: no pulse is cut, none comes before its darkness is due."""
    clock, lit_s = VirtualClock(), []
    ledger = MemoryLedger(clock)
    run = run_of(SIM, 0.1, 120)
    pulse(run, ledger, clock, lambda _: lit_s.append(clock.now_s()))
    assert len(lit_s) == run.count == 75
    assert clock.now_s() == pytest.approx(120)
    doses = {eye: ledger.spent_j_per_cm2(eye) for eye in EYES}
    assert doses["OD"] == doses["OS"] > 0


def test_a_spent_ledger_ends_the_train() -> None:
    """The limit of light that belongs to no visit holds here too."""
    clock, pulses = VirtualClock(), list[str]()
    limits = light_limits()
    ledger = MemoryLedger(clock)
    run = run_of(SIM, None, 120)
    ledger.reserve(("OS",), 0.99 * limits.stop_without_visit_j_per_cm2, limits.stop_j_per_cm2)
    with pytest.raises(LightLimit):
        pulse(run, ledger, clock, pulses.append)
    assert 0 < len(pulses) < run.count


@pytest.mark.parametrize(("head", "colours"), [("imx296_power", ("green", "amber")), ("imx296", ("green", "red"))])
def test_guide_has_the_runs_that_a_day_permits(head: str, colours: tuple[str, ...]) -> None:
    """Whole runs of two minutes at the highest drive, with what the last pulse reserves beyond its own light."""
    spec, stop_j_per_cm2 = load_head(HEADS / f"{head}.toml"), light_limits().stop_without_visit_j_per_cm2
    runs = {"green": "-", "amber": "-", "red": "-"}
    for colour in colours:
        run = run_of(in_colour(spec, colour), None, 120)
        second = hazard_of(run.spec).dose_j_per_cm2(run.illumination, 1)
        reserved = second * (run.spec.light.max_on_s + LIT_AFTER_KILL_S - run.on_s)
        runs[colour] = f"{(stop_j_per_cm2 - reserved) // (second * run.on_s * run.count):.0f}"
    row = re.search(rf"^\| `heads/{head}.toml` \| (\S+) \| (\S+) \| (\S+) \| ", text("hardware/assembly.md"), re.M)
    assert row is not None
    assert row.groups() == tuple(runs.values())


@pytest.mark.parametrize(("head", "why"), [("bench", "no lamp of its own"), ("imx296_power", "no blue LEDs")])
def test_a_head_without_such_leds_is_refused(head: str, why: str) -> None:
    spec = load_head(HEADS / f"{head}.toml")
    if head != "bench":
        spec = spec.model_copy(update={"light": spec.light.model_copy(update={"colour": "blue"})})
    with pytest.raises(SpecError, match=why):
        run_of(spec, None, 20)


def test_a_reading_above_a_limit_is_no_go_and_says_which() -> None:
    run = run_of(POWER, None, 20)
    assert run.permitted_uw < run.assumed_uw
    head = Path("head.toml")
    for shown_uw, go, says in [
        (run.expected_uw, True, "1 times"),
        (3 * run.expected_uw, True, "look at polarisers"),
        (1.01 * run.permitted_uw, False, "an eye may have"),
    ]:
        verdict = judge_reading(run, shown_uw, peak=True)
        assert verdict.is_go == go
        assert says in words(head, run, verdict)
    measured = replace(run, assumed_uw=1.4)
    assert "the guard counts for this level" in words(head, measured, judge_reading(measured, 1.5, peak=True))
    with pytest.raises(SettingError, match="no light"):
        judge_reading(run, 1e-5)


def test_a_slow_meter_shows_half() -> None:
    run = run_of(POWER, None, 20)
    assert judge_reading(run, 1.0).axis_uw == pytest.approx(2.0), "what may be the mean counts twice"


def test_a_reading_at_a_level_is_judged_as_at_full_drive() -> None:
    full = MeterReading("green", 9.0, 43.0, 525.0, "meter X, 2026-11-25")
    dim = replace(full, axis_uw=0.252 * full.axis_uw, waist_mw_per_cm2=0.252 * full.waist_mw_per_cm2).scaled(0.252)
    shares = [judge(POWER, design_of(POWER), reading, light_limits()).shares for reading in (full, dim)]
    assert [share.value for share in shares[1]] == pytest.approx([share.value for share in shares[0]])


@pytest.mark.parametrize(("shown", "status", "says"), [("1", 0, "GO at this level"), ("60", 1, "NO GO")])
def test_the_command_asks_lights_and_judges(tmp_path: Path, shown: str, status: int, says: str) -> None:
    text = small_head_toml("small", exposure_s=0.05).replace("[light]", "[light]\nmax_on_s = 0.1")
    (head := tmp_path / "head.toml").write_text(text)
    arguments = ["meter", "--head", str(head), "--seconds", "0.1", "--data", str(tmp_path / "data")]
    made = CliRunner().invoke(app, arguments, input=f"y\n{shown}\n")
    assert made.exit_code == status, made.output
    assert says in made.output
    refused = CliRunner().invoke(app, arguments, input="n\n")
    assert refused.exit_code == 1
    assert "pulse" not in refused.stderr
