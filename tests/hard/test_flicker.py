"""Bands of a flickering lamp: found by their line, taken out of picture and burst, never an object's own lines."""

from collections import deque
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from device.recon.assessment.quality_figures import MAX_BANDING
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.estimation.flicker import row_gain
from device.values import Reconstruction
from tests import scenes
from tests.hard.exposed import Exposed, exposed

# PCC: the harmonics take the object's own detail at their frequencies along, in proportion to the share of its rows
LOST = {0.015: 0.01, 0.05: 0.03, 0.1: 0.03, 0.15: 0.08}
REFRACTION_DPT = 0.15  # the standard deviation of these frames is about 0.05


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_bands_cost_neither_picture_nor_refraction(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "flicker" not in clean.report.quality
    assert clean.report.refraction_dpt is not None
    for share in (0.015, 0.05, 0.15):
        made = eye.make(eye.banded(share))
        assert made.report.quality["flicker"] == pytest.approx(share / 3**0.5, rel=0.1)  # the rms of a triangle
        assert eye.pcc(made) > eye.pcc(clean) - LOST[share]
        if share < 0.1:  # of stronger bands enough is left for the message, and for no refraction
            assert made.report.quality["banding"] < MAX_BANDING
            assert made.report.refraction_dpt is not None
            clean_dpt = clean.report.refraction_dpt["sphere"]
            assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)


def test_bands_are_found_behind_lenslets() -> None:
    """Their rows show the retina, so that the line of the bands stands out less: 26 times instead of 30."""
    eye = exposed("imx296_lenslets", 0.0, 8000.0)
    clean, made = eye.make(eye.frames[0]), eye.make(eye.banded(0.05))
    assert "flicker" not in clean.report.quality
    assert eye.pcc(made) > eye.pcc(clean) - LOST[0.05]


def test_lines_of_the_object_stay(tmp_path: Path) -> None:
    lines = np.where(np.arange(1400) // 35 % 2, 230, 25).astype(np.uint8)
    photo = tmp_path / "lines.png"
    Image.fromarray(np.broadcast_to(lines[:, None, None], (1400, 1400, 3)).copy()).save(photo)
    chart = Exposed("sim", 0.0, 15000.0, photo)
    light = chart.frames[0].mean(axis=1, dtype=np.float64) - chart.spec.camera.black_dn
    assert row_gain(light) is not None  # its row means look like flicker
    assert "flicker" not in chart.make(chart.frames[0]).report.quality


def test_a_burst_under_a_flickering_lamp_is_joined() -> None:
    eye = Exposed("sim", 0.0, 1500.0, frames=4)
    bursts = BurstReconstructor(eye.make, scenes.PLANNER)
    (clean,), (made,) = (
        deque(bursts.steps(frames, simulated=True), maxlen=1)
        for frames in (eye.frames, [eye.banded(0.1, k) for k in range(4)])
    )
    assert isinstance(clean, Reconstruction)
    assert isinstance(made, Reconstruction)
    assert all(use.used for use in made.report.frames)
    assert eye.pcc(made) > eye.pcc(clean) - LOST[0.1]
