"""Light of a human eye with each head, and the computed figures of the READMEs (L, M, S1)."""

import re
from pathlib import Path

import pytest

from tests.paper.bench import Bench
from tests.paper.light import WEAK, human_light, shipped_heads
from tests.paper.report import EXPERIMENTS
from tests.paper.rules import SCENES as RULED
from tests.paper.rules import compare_rules
from tests.paper.screen import FLAT, dots_before_and_after

pytestmark = pytest.mark.paper

ROOT = Path(__file__).parents[2]


def figures(readme: str, pattern: str) -> tuple[float, ...]:
    """Return the numbers in a README at the groups of a pattern, which must match once."""
    found = re.findall(pattern, " ".join((ROOT / readme).read_text().split()))
    assert len(found) == 1, pattern
    return tuple(float(x) for x in found[0])


@pytest.mark.parametrize("name", shipped_heads())
def test_readme_has_the_light_of_a_human_eye_with_each_shipped_head(name: str) -> None:
    light = human_light(name)
    assert light.exposure_s == 0.1, "README says so"
    printed = (round(light.mean_e), round(light.peak_e, -1))
    assert figures("hardware/README.md", rf"\| `{name}\.toml` \| (\d+) \| (\d+) \|") == printed
    if name == WEAK:
        first_page = r"`imx296\.toml` collects a mean of (\d+) electrons a pixel and (\d+) in the brightest"
        assert figures("README.md", first_page) == printed


@pytest.mark.timeout(600)
def test_every_assertion_about_the_light_holds() -> None:
    outcome = EXPERIMENTS["L"].run(Bench(merged=2))
    assert [claim.what for claim in outcome.claims if not claim.holds] == []
    assert [shown.file for shown in outcome.shown if shown.file] == [
        "human-eye.png",
        "heads-eye.png",
        "elements-eye.png",
    ]


@pytest.mark.timeout(600)
def test_every_assertion_about_lenslets_holds() -> None:
    outcome = EXPERIMENTS["D"].run(Bench(merged=2))
    assert [claim.what for claim in outcome.claims if not claim.holds] == []
    assert [row[0] for row in outcome.sheets[0].rows] == ["diffuser", "square array", "aperiodic lenslets"]


def test_readme_has_the_gain_of_gradient_under_both_rules_for_mu() -> None:
    printed = figures(
        "services/research/README.md",
        r"it is ([\d.]+) to ([\d.]+) dB nearer to the truth, by cross-validation for both ([\d.]+) to ([\d.]+) dB",
    )
    found = [compare_rules(Bench(), name) for name in RULED]
    best = [result.gain_db for result in found]
    validated = [result.gradient_db - result.validated_db for result in found]
    assert printed == pytest.approx((min(best), max(best), min(validated), max(validated)), abs=0.051)
    assert all(result.flat_first_db - result.validated_db > result.gain_db / 2 for result in found), (
        "README: most of that"
    )


def test_readme_has_the_ssim_of_the_dots() -> None:
    printed = figures("tests/paper/README.md", r"On a flat screen it is ([\d.]+) and ([\d.]+) here")
    bench = Bench()
    take = bench.expose("paper_dots", FLAT)
    found = [take.score(picture).ssim for picture in dots_before_and_after(bench, take)]
    assert printed == pytest.approx(found, abs=0.0006)
