"""Wave optics against ray tracing of the same surface, and against limits known without a diffuser."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1

from device.config.element import ElementSpec
from device.config.head_file import load_head
from device.optics.diffuser import Refraction, caustic_on, grid_for
from device.sim.render import convolved_with_disc
from tests.textbook.rays import ray_caustic

HEAD = load_head(Path(__file__).parents[2] / "hardware" / "heads" / "sim.toml")
OPTICS, PITCH_UM = HEAD.optics, HEAD.camera.pitch_um
DOT_PX = 49.5 / PITCH_UM  # the paper's 275 um dot on its sensor


@pytest.mark.parametrize("eye", [Refraction(), Refraction(4.0), Refraction(-3.0, 1.0, -0.5)])
def test_rays_and_waves_agree_after_a_blur(eye: Refraction) -> None:
    """OPTICS.md 2.7: correlation at least 0.98 after a blur of 49.5 um; below 0.9 without."""
    grid = grid_for(OPTICS, PITCH_UM)
    waves, rays = caustic_on(grid, OPTICS, 1, eye, lines=1), ray_caustic(OPTICS, grid, 1, eye)
    assert rays.sum() == pytest.approx(1, abs=1e-5)
    assert (
        np.corrcoef(convolved_with_disc(waves, DOT_PX).ravel(), convolved_with_disc(rays, DOT_PX).ravel())[0, 1] >= 0.98
    )
    assert np.corrcoef(waves.ravel(), rays.ravel())[0, 1] < 0.9


def test_without_a_diffuser_a_focusing_eye_makes_the_airy_disc() -> None:
    """A wavefront that converges onto the sensor: the first dark ring has the radius 1.22 lambda z / d."""
    smooth = ElementSpec(slope_fwhm_deg=1e-6)
    flat = OPTICS.model_copy(update={"element": smooth, "iris_um": 400.0, "diffuser_to_sensor_um": 60000.0})
    focus = Refraction(1 / (flat.diffuser_to_sensor_um * 1e-6 * flat.angular_magnification**2))
    grid = grid_for(flat, 8.0)
    spot = caustic_on(grid, flat, 1, focus, lines=1)
    away_um = np.hypot(*np.meshgrid(grid.x_um, grid.x_um))[:: grid.step, :: grid.step]
    x = np.pi * flat.iris_um * away_um / (flat.wavelength_um * flat.diffuser_to_sensor_um)
    airy = (2 * j1(np.maximum(x, 1e-9)) / np.maximum(x, 1e-9)) ** 2
    near = away_um < 300
    assert np.corrcoef(spot[near], airy[near])[0, 1] > 0.999
