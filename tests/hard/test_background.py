"""Uneven stray light: found outside the lit disc, taken out of picture and refraction, never out of a clean frame."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import pcc
from device.recon.estimation.background import Background
from device.recon.estimation.shading import Shading
from device.recon.methods import METHODS
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resolution import working_bin
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import lit_frames
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts
from services import resources
from tests import scenes
from tests.paper.bench import with_changes
from tests.simulated import coarse

Floats = NDArray[np.float64]
LOST = 0.002  # PCC: the noise of the stray light itself costs as much
REFRACTION_DPT = 0.1  # the standard deviation of these frames is about 0.05


class Exposed:
    """A bright frame of one drawn eye behind the paper's diffuser, or on a sensor that the lit disc fills."""

    def __init__(self, head: str, seed: int, m_dpt: float) -> None:
        changes = {"camera.backend": "sim", "light.backend": "sim", "sim.peak_e": 15000.0}
        changes |= {"sim.seed": seed, "sim.eye.m_dpt": m_dpt}
        self.spec = coarse(with_changes(load_head(resources.HEADS / f"{head}.toml"), changes), 2)
        of = World(self.spec, VirtualClock())
        self.calibration = simulated_calibration(of)
        self.truth = of.truth(self.spec.light.colour).astype(np.float64)
        (self.counts,) = lit_frames(of)
        self.inside = field_mask(of.shape, field_radius_px(self.calibration))
        self.make = Reconstructor(self.calibration, of.shape, scenes.PLANNER, VirtualClock())

    def under(self, light: Floats) -> Counts:
        """Return the counts with stray light added, in shares of the mean light of the frame."""
        mean_dn = float(self.counts.mean()) - self.spec.camera.black_dn
        lit = np.rint(self.counts + light * mean_dn)
        return np.clip(lit, 0, self.spec.camera.white_dn).astype(self.counts.dtype)

    def figures(self, counts: Counts) -> tuple[float, float | None]:
        """Return the correlation with the truth, and the spectacle correction in dpt."""
        made = self.make(counts)
        found = made.report.refraction_dpt or {}
        return pcc(made.picture.astype(np.float64), self.truth, self.inside), found.get("sphere")

    def background(self, counts: Counts) -> NDArray[np.float32] | None:
        """Return the background that the solver finds in these counts, with the PSF of the relaxed eye."""
        n = working_bin(self.calibration.psfs[0])
        model = METHODS["variation"].model(self.calibration, counts.shape, n, scenes.PLANNER, 0)
        return Background(Shading(model), n).fit(Preprocessor(self.calibration, model.grid)(counts))


@cache
def exposed(head: str, seed: int, m_dpt: float) -> Exposed:
    return Exposed(head, seed, m_dpt)


def gradient(shape: tuple[int, int]) -> Floats:
    return np.broadcast_to(np.linspace(0, 0.6, shape[1]), shape)


def corner(shape: tuple[int, int]) -> Floats:
    down, right = (np.linspace(0, 1, size) for size in shape)
    return 0.5 * np.exp(-((down[:, None] - 0.9) ** 2 + (right - 0.9) ** 2) / (2 * 0.2**2))


def bowl(shape: tuple[int, int]) -> Floats:
    down, right = (np.linspace(-1, 1, size) for size in shape)
    return 0.3 * (down[:, None] ** 2 + right**2)


@pytest.mark.parametrize("light", [gradient, corner, bowl])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_uneven_stray_light_costs_neither_picture_nor_refraction(light, m_dpt: float) -> None:
    eye = exposed("sim", 5, m_dpt)
    clean, clean_dpt = eye.figures(eye.counts)
    lit, lit_dpt = eye.figures(eye.under(light(eye.counts.shape)))
    assert lit > clean - LOST
    assert clean_dpt is not None
    assert lit_dpt == pytest.approx(clean_dpt, abs=REFRACTION_DPT)


@pytest.mark.parametrize(("seed", "m_dpt"), [(5, 0.0), (5, -4.0), (6, 4.0)])
def test_a_clean_frame_has_no_uneven_background(seed: int, m_dpt: float) -> None:
    eye = exposed("sim", seed, m_dpt)
    assert eye.background(eye.counts) is None


def test_the_found_background_is_the_added_light() -> None:
    eye = exposed("sim", 5, 0.0)
    mean_dn = float(eye.counts.mean()) - eye.spec.camera.black_dn
    light = gradient(eye.counts.shape)
    found = eye.background(eye.under(light))
    assert found is not None
    left = (light.shape[1] - found.shape[1]) // 2  # the solver's window is the middle of the sensor
    added = light[:, left : left + found.shape[1]] * mean_dn
    apart = (found - found.mean()) - (added - added.mean())  # the constant belongs to the shading fit
    assert np.abs(apart).max() < 0.02 * np.ptp(added)


def test_on_a_sensor_that_the_disc_fills_only_a_constant_is_fitted() -> None:
    eye = exposed("imx296", 5, 0.0)
    assert eye.background(eye.under(gradient(eye.counts.shape))) is None
