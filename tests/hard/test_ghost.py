"""A displaced second image: found by its light beyond the field, taken out and reported, never in a clean frame."""

import pytest

from device.config.scene import LightFlaws
from tests.hard.exposed import Exposed, exposed

LOST = 0.015  # PCC
REFRACTION_DPT = 0.15  # the standard deviation of these frames is about 0.05


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_a_ghost_costs_neither_picture_nor_refraction_and_is_reported(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "ghost" not in clean.report.quality
    assert clean.report.refraction_dpt is not None
    assert eye.calibration.geometry is not None
    right_px = round(LightFlaws().ghost_deg[0] * eye.calibration.geometry.px_per_deg)
    for share in (0.1, 0.3):
        made = eye.make(Exposed(head, m_dpt, peak_e, more={"sim.light.ghost": share}).frames[0])
        assert eye.pcc(made) > eye.pcc(clean) - LOST
        assert made.report.quality["ghost"] == pytest.approx(share, rel=0.25)
        (words,) = [warning for warning in made.report.warnings if "second image" in warning]
        assert f"{right_px:+d} pixels" in words
        assert made.report.refraction_dpt is not None
        clean_dpt = clean.report.refraction_dpt["sphere"]
        assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)
