"""Pictures of one drawn eye in the light of its head behind diffuser, lenslets and one lens, by the default solver."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.config.scene import ObjectSpec
from device.recon.assessment.metrics import PictureScorer, Scores
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.fundus import field_mask, fundus
from device.sim.scene_files import simulate_exposure
from tests.scenes import PLANNER
from tests.simulated import SCENES, coarse

DETAIL_DEG, RIM_PX = 2.0, 3


def scene(head: str, m_dpt: float, thing: ObjectSpec | None = None) -> InstrumentSpec:
    """Return the scene of a human eye with a head; `thing`: another object than its retina."""
    spec = coarse(load_head(SCENES / f"human_eye_{head}.toml"), 2)
    assert spec.sim is not None
    changed = {"eye": spec.sim.eye.model_copy(update={"m_dpt": m_dpt}), "object": thing or spec.sim.object}
    return spec.model_copy(update={"sim": spec.sim.model_copy(update=changed)})


@cache
def scores(head: str, m_dpt: float = 0.0) -> tuple[Scores, dict[str, object]]:
    """Return the scores of the picture of a human eye with a head, and the reported refraction."""
    exposure = simulate_exposure(scene(head, m_dpt))
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


def test_a_light_that_fades_shows_the_refraction() -> None:
    """The ring's penumbra is 22 degrees wide; with a sharp edge in its place this frame was refused."""
    _, refraction = scores("imx296_power_lenslets", -6.0)
    assert refraction["sphere"] == pytest.approx(6.0, abs=0.08)
    assert float(str(refraction["sd"])) < 0.03


def test_half_a_field_shows_the_refraction(tmp_path: Path) -> None:
    retina = fundus((400, 400), 400 / 33.4, 33.4, 7).reflectance["green"]
    retina[: len(retina) // 2] = 0
    Image.fromarray((255 * retina / retina.max()).astype(np.uint8)).save(tmp_path / "half.png")
    exposure = simulate_exposure(scene("imx296_lenslets", 3.0, ObjectSpec(kind="image", image=tmp_path / "half.png")))
    solver = (Recipe("evidence", 2),)
    make = Reconstructor(exposure.calibration, exposure.counts.shape, PLANNER, VirtualClock(), solver, timed=False)
    report = make(exposure.counts, simulated=True).report
    assert report.quality["coverage"] is not None
    assert report.quality["coverage"] < 0.6
    assert report.refraction_dpt is not None
    assert report.refraction_dpt["sphere"] == pytest.approx(-3.0, abs=0.1)


@pytest.mark.parametrize("m_dpt", [0.0, -6.0])
def test_the_spots_of_lenslets_carry_the_refraction(m_dpt: float) -> None:
    _, refraction = scores("imx296_lenslets", m_dpt)
    assert refraction["sphere"] == pytest.approx(-m_dpt, abs=0.25)
