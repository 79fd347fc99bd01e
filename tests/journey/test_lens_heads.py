"""Simulated heads at the light of a human eye through the instrument: a press, its verdict and its report."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from device.config.head_file import load_head
from device.optics.lit_angle import has_sharp_edge
from services import resources
from tests.journey.conftest import rig_builder, traced_world
from tests.simulated import coarse


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", ["sim_imx296_lenslets", "sim_imx296_power_lenslets"])
def test_press_on_lenslets_keeps_a_good_picture(name: str, tmp_path: Path) -> None:
    """Only a field with a sharp edge gives the refraction (OPTICS.md 4.9), so not that of the high-power ring."""
    spec = coarse(load_head(resources.HEADS / f"{name}.toml"), 2)
    with ExitStack() as undo:
        rig = rig_builder(traced_world(spec), tmp_path / "plans")(tmp_path, undo, wait=False)
        assert rig.exam.ready.wait(300)
        kept = rig.exam.press("OD").result(300)
    report = kept.report
    assert report.verdict is not None
    assert (report.verdict.word, report.verdict.code, report.warnings) == ("good", None, ())
    assert report.quality["resolution_um"] < 60
    if has_sharp_edge(spec):
        assert report.refraction_dpt["sphere"] == pytest.approx(0, abs=0.1)
