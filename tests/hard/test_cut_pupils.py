"""Pupils that hide part of the diffuser: the picture is made with the rest, and the refraction is right or refused."""

import pytest

from device.recon.corrections import MAX_EXPLAINED
from tests.hard.exposed import Exposed, exposed

PUPILS = {
    "cut by 18 %": {"sim.eye.pupil_um": 7700.0, "sim.eye.decentred_um": 3260.0},
    "small and off centre": {"sim.eye.pupil_um": 4000.0, "sim.eye.decentred_um": 900.0},
}
HIDDEN = {"cut by 18 %": 0.225, "small and off centre": 0.022}  # share of the PSF's light beyond the pupil's edge


@pytest.mark.parametrize(
    ("head", "m_dpt", "peak_e", "pupil"),
    [
        ("imx296", 0.0, 8000.0, "small and off centre"),
        ("sim", -4.0, 15000.0, "cut by 18 %"),
        ("imx296_lenslets", 0.0, 8000.0, "cut by 18 %"),
    ],
)
def test_the_pupil_is_found_and_the_picture_made_with_the_rest(
    head: str, m_dpt: float, peak_e: float, pupil: str
) -> None:
    hidden = Exposed(head, m_dpt, peak_e, more=PUPILS[pupil])
    made = hidden.make(hidden.frames[0])
    report = made.report
    assert report.quality["pupil"] == pytest.approx(HIDDEN[pupil], abs=0.015)
    assert report.residual is not None
    assert report.residual < MAX_EXPLAINED
    assert [words for words in report.warnings if "pupil hides" in words] == list(report.warnings)
    eye = report.refraction_dpt
    assert eye is not None
    sphere, sd = eye["sphere"], eye["sd"]
    assert isinstance(sphere, float)
    assert isinstance(sd, float)
    assert abs(sphere + m_dpt) < 3 * sd < 0.6
    whole = exposed(head, m_dpt, peak_e)
    assert hidden.pcc(made) > whole.pcc(whole.make(whole.frames[0])) - 0.03


@pytest.mark.parametrize(("head", "m_dpt", "peak_e"), [("sim", 0.0, 500.0), ("imx296", 3.0, 8000.0)])
def test_a_whole_pupil_is_not_searched_for(head: str, m_dpt: float, peak_e: float) -> None:
    whole = exposed(head, m_dpt, peak_e)
    report = whole.make(whole.frames[0]).report
    assert "pupil" not in report.quality
    assert report.refraction_dpt is not None
    assert report.refraction_dpt["refused"] is None
    assert report.warnings == ()


def test_no_pupil_explains_a_frame_of_the_whole_diffuser_better() -> None:
    whole = exposed("imx296", 0.0, 8000.0)
    refractor = whole.make.refractor
    assert refractor is not None
    assert refractor.find_pupil(whole.frames[0], None, None) is None
