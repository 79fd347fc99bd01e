"""Bands of a flickering lamp: found by their line, taken out of picture and burst, never an object's own lines."""

from collections import deque
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import pcc
from device.recon.assessment.quality_figures import MAX_BANDING
from device.recon.burst_reconstructor import BurstReconstructor
from device.recon.estimation.flicker import row_gain
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import lit_frames
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts, Reconstruction
from services import resources
from tests import scenes
from tests.hard import defects
from tests.paper.bench import with_changes
from tests.simulated import coarse

# PCC: the harmonics take the object's own detail at their frequencies along, in proportion to the share of its rows
LOST = {0.015: 0.01, 0.05: 0.03, 0.1: 0.03, 0.15: 0.08}
REFRACTION_DPT = 0.15  # the standard deviation of these frames is about 0.05


class Exposed:
    """Frames of one drawn eye, or of a photograph, behind a head's diffuser, and its solvers."""

    def __init__(self, head: str, m_dpt: float, peak_e: float, photo: Path | None = None, frames: int = 1) -> None:
        changes = {"camera.backend": "sim", "light.backend": "sim", "sim.peak_e": peak_e, "sim.seed": 5}
        changes |= {"sim.eye.m_dpt": m_dpt}
        if photo is not None:
            changes |= {"sim.object.kind": "image", "sim.object.image": str(photo)}
        self.spec = coarse(with_changes(load_head(resources.HEADS / f"{head}.toml"), changes), 2)
        of = World(self.spec, VirtualClock())
        calibration = simulated_calibration(of)
        self.truth = of.truth(self.spec.light.colour).astype(np.float64)
        self.frames = lit_frames(of, frames)
        self.inside = field_mask(of.shape, field_radius_px(calibration))
        self.make = Reconstructor(calibration, of.shape, scenes.PLANNER, VirtualClock())

    def banded(self, share: float, frame: int = 0) -> Counts:
        """Return a frame with bands of +- `share`, whose phase differs from frame to frame."""
        return defects.bands(self.frames[frame], self.spec.camera, share, phase=0.3 + 0.37 * frame)

    def pcc(self, made: Reconstruction) -> float:
        return pcc(made.picture.astype(np.float64), self.truth, self.inside)


@cache
def exposed(head: str, m_dpt: float, peak_e: float) -> Exposed:
    return Exposed(head, m_dpt, peak_e)


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
