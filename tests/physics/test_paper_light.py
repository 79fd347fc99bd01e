"""The light of a human eye with each head, and the figures of README that are computed (L, M, S1)."""

import re
from pathlib import Path

import pytest

from device.spec import load_head
from services.instrument.paper.bench import SCENES, Bench
from services.instrument.paper.light import HEAD, SCENE, human_light, shipped_heads
from services.instrument.paper.report import EXPERIMENTS
from services.instrument.paper.rules import SCENES as RULED
from services.instrument.paper.rules import rules
from services.instrument.paper.screen import FLAT, cells, dots_before_and_after

pytestmark = pytest.mark.paper

README = " ".join((Path(__file__).parents[2] / "README.md").read_text().split())


def figures(pattern: str) -> tuple[float, ...]:
    """The numbers that README has at the groups of a pattern; it must be there once."""
    found = re.findall(pattern, README)
    assert len(found) == 1, pattern
    return tuple(float(x) for x in found[0])


@pytest.mark.parametrize("name", shipped_heads())
def test_readme_has_the_light_of_a_human_eye_with_each_shipped_head(name: str) -> None:
    mean_e, peak_e = figures(rf"\| `{name}\.toml` \| (\d+) \| (\d+) \|")
    light = human_light(name)
    assert light.exposure_s == 0.1, "README says so"
    assert mean_e == round(light.mean_e)
    assert peak_e == round(light.peak_e, -1)


def test_the_scene_of_a_human_eye_has_the_light_of_its_head() -> None:
    scene, head = load_head(SCENES / f"{SCENE}.toml"), load_head(SCENES.parents[2] / "hardware/heads" / f"{HEAD}.toml")
    assert scene.sim is not None
    assert scene.sim.peak_e == pytest.approx(human_light(HEAD).peak_e, rel=0.1)
    for key in ("rows", "cols", "pitch_um", "bit_depth", "full_well_e", "read_noise_e", "exposure_s"):
        assert getattr(scene.camera, key) == getattr(head.camera, key), key


def test_every_assertion_about_the_light_holds() -> None:
    outcome = EXPERIMENTS["L"].run(Bench(merged=2))
    assert [claim.what for claim in outcome.claims if not claim.holds] == []
    assert [shown.file for shown in outcome.shown if shown.file] == ["human-eye.png"]


def test_readme_has_the_gain_of_gradient_under_both_rules_for_mu() -> None:
    said = figures(
        r"it is ([\d.]+) to ([\d.]+) dB nearer to the truth, by cross-validation for both ([\d.]+) to ([\d.]+) dB"
    )
    found = [rules(Bench(), name) for name in RULED]
    best = [one.gain_db for one in found]
    validated = [one.gradient_db - one.validated_db for one in found]
    assert said == pytest.approx((min(best), max(best), min(validated), max(validated)), abs=0.051)
    assert all(one.flat_first_db - one.validated_db > one.gain_db / 2 for one in found), "README: most of that"


def test_readme_has_the_ssim_that_is_not_reproduced() -> None:
    said = figures(r"SSIM 0\.59 to 0\.85 by the flat-field correction of dots\. Here it is ([\d.]+) to ([\d.]+),")
    bench = Bench()
    take = bench.take("paper_dots")
    found = [take.score(picture).ssim for picture in dots_before_and_after(bench, take)]
    assert said == pytest.approx(found, abs=0.0006)
    flat = bench.take("paper_dots", FLAT)
    settings = [*cells("curved", take, bench), *cells("flat", flat, bench)]
    lower = sum(one.after.ssim < one.before.ssim for one in settings)
    assert figures(r"lower after the correction than before in (\d+) of (\d+) settings") == (lower, len(settings))
