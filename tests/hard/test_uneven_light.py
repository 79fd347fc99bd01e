"""Vignetting and light in a corner of the sensor: taken out of the frame and reported, never in a clean frame."""

import pytest

from tests.hard import defects
from tests.hard.exposed import exposed

LOST = 0.02  # PCC
REFRACTION_DPT = 0.2  # the standard deviation of these frames is about 0.05
HEADS = [("sim", 15000.0), ("imx296", 8000.0)]


@pytest.mark.parametrize(("head", "peak_e"), HEADS)
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_vignetting_costs_neither_picture_nor_refraction_and_is_reported(
    head: str, peak_e: float, m_dpt: float
) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "falloff" not in clean.report.quality
    assert clean.report.refraction_dpt is not None
    for share in (0.2, 0.4):
        made = eye.make(defects.vignetting(eye.frames[0], eye.spec.camera, share))
        assert eye.pcc(made) > eye.pcc(clean) - LOST
        assert share / 3 < (made.report.quality["falloff"] or 0) < share  # the lit part ends before the corners
        assert [warning for warning in made.report.warnings if "falls off" in warning]
        assert made.report.refraction_dpt is not None
        clean_dpt = clean.report.refraction_dpt["sphere"]
        assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)


@pytest.mark.parametrize(("head", "peak_e"), HEADS)
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_light_in_a_corner_costs_no_picture(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "leak" not in clean.report.quality
    for share in (0.1, 0.5, 1.0):
        made = eye.make(defects.leak(eye.frames[0], eye.spec.camera, share))
        assert eye.pcc(made) > eye.pcc(clean) - LOST
        if head == "imx296":  # the unlit part of the other sensor shows the corner before the solution
            assert [warning for warning in made.report.warnings if "bottom right corner" in warning]


def test_saturated_pixels_stay_saturated() -> None:
    eye = exposed("imx296", 0.0, 8000.0)
    counts = defects.vignetting(eye.frames[0], eye.spec.camera, 0.4)
    counts[:8, :8] = eye.spec.camera.white_dn
    made = eye.make(counts)
    assert made.report.quality["falloff"]
    assert made.report.quality["saturated"] == pytest.approx(64 / counts.size, rel=0.05)
