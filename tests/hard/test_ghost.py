"""A displaced second image: found by its light beyond the field, taken out and reported, never in a clean frame."""

import numpy as np
import pytest

from device.values import Counts
from tests.hard.exposed import Exposed, exposed

LOST = 0.015  # PCC
REFRACTION_DPT = 0.15  # the standard deviation of these frames is about 0.05
RIGHT_PX, DOWN_PX = 18, 8


def with_ghost(eye: Exposed, share: float) -> Counts:
    """Return the counts with a second image; beyond the sensor's edges it is as the edge."""
    camera = eye.spec.camera
    light = eye.frames[0].astype(np.float32) - camera.black_dn
    padded = np.pad(light, ((DOWN_PX, 0), (RIGHT_PX, 0)), mode="edge")
    both = (light + share * padded[: light.shape[0], : light.shape[1]]) / (1 + share)
    return np.clip(np.rint(camera.black_dn + both), 0, camera.white_dn).astype(np.uint16)


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_a_ghost_costs_neither_picture_nor_refraction_and_is_reported(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "ghost" not in clean.report.quality
    assert clean.report.refraction_dpt is not None
    for share in (0.1, 0.3):
        made = eye.make(with_ghost(eye, share))
        assert eye.pcc(made) > eye.pcc(clean) - LOST
        assert made.report.quality["ghost"] == pytest.approx(share, rel=0.25)
        (words,) = [warning for warning in made.report.warnings if "second image" in warning]
        assert f"{RIGHT_PX:+d} pixels" in words
        assert made.report.refraction_dpt is not None
        clean_dpt = clean.report.refraction_dpt["sphere"]
        assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)
