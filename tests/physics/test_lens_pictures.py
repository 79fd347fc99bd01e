"""Pictures of one drawn eye in the light of its head behind diffuser, lenslets and one lens, by the default solver."""

from functools import cache

import numpy as np
import pytest

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import PictureScorer, Scores
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import simulate_exposure
from tests.scenes import PLANNER
from tests.simulated import SCENES, coarse

DETAIL_DEG, RIM_PX = 2.0, 3


@cache
def scores(head: str, m_dpt: float = 0.0) -> tuple[Scores, dict[str, object]]:
    """Return the scores of the picture of a human eye with a head, and the reported refraction."""
    spec = coarse(load_head(SCENES / f"human_eye_{head}.toml"), 2)
    assert spec.sim is not None
    eye = spec.sim.eye.model_copy(update={"m_dpt": m_dpt})
    spec = spec.model_copy(update={"sim": spec.sim.model_copy(update={"eye": eye})})
    exposure = simulate_exposure(spec)
    made = Reconstructor(exposure.calibration, exposure.counts.shape, PLANNER, VirtualClock())(
        exposure.counts, simulated=True
    )
    radius_px = field_radius_px(exposure.calibration)
    inside = field_mask(exposure.counts.shape, radius_px - RIM_PX)
    assert exposure.calibration.geometry is not None
    detail_px = DETAIL_DEG * exposure.calibration.geometry.px_per_deg
    judge = PictureScorer(exposure.truth, np.asarray(inside, bool), detail_px, exposure.vessels)
    return judge(made.picture), dict(made.report.refraction_dpt or {})


def test_lenslets_show_the_vessels_that_the_diffuser_loses() -> None:
    diffuser, lenslets = (scores(head)[0] for head in ("imx296", "imx296_lenslets"))
    assert lenslets.pcc > max(0.97, diffuser.pcc + 0.05)
    assert lenslets.psnr_db > diffuser.psnr_db + 4
    assert lenslets.highpass_pcc > max(0.93, diffuser.highpass_pcc + 0.15)


def test_one_stopped_lens_has_a_picture_without_a_refraction() -> None:
    control, refraction = scores("imx296_control")
    assert control.highpass_pcc > 0.85
    assert refraction["sphere"] is None


@pytest.mark.parametrize("m_dpt", [0.0, -6.0])
def test_the_spots_of_lenslets_carry_the_refraction(m_dpt: float) -> None:
    _, refraction = scores("imx296_lenslets", m_dpt)
    assert refraction["sphere"] == pytest.approx(-m_dpt, abs=0.25)
