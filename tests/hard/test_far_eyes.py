"""Eyes at the end of the range of refractions and beyond it: solved as others to 10 dioptres, then named."""

import pytest

from device.recon.assessment.psf_consistency import Match
from device.recon.assessment.quality_figures import MISMATCHES
from tests.hard.exposed import exposed

LOST = 0.02  # PCC: the sensor cuts off more of the widest PSF
REFRACTION_DPT = 0.3  # a scale of 1 % of the PSF is 3 dpt: the standard deviation of these frames is 0.1


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [-10.0, 10.0])
def test_an_eye_of_ten_dioptres_is_solved_as_a_relaxed_one(head: str, peak_e: float, m_dpt: float) -> None:
    relaxed, eye = exposed(head, 0.0, peak_e), exposed(head, m_dpt, peak_e)
    made = eye.make(eye.frames[0])
    assert eye.pcc(made) > relaxed.pcc(relaxed.make(relaxed.frames[0])) - LOST
    assert made.report.refraction_dpt is not None
    assert made.report.refraction_dpt["sphere"] == pytest.approx(-m_dpt, abs=REFRACTION_DPT)


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [-15.0, 12.0])
def test_an_eye_beyond_them_is_named_and_no_calibration_is_asked_for(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    assert MISMATCHES[Match.FOREIGN_OR_FAR] in eye.make(eye.frames[0]).report.warnings
