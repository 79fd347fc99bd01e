"""Uneven stray light: found outside the lit disc, taken out of picture and refraction, never out of a clean frame."""

import numpy as np
import pytest

from device.recon.estimation.background import Background
from device.recon.estimation.shading import Shading
from device.recon.methods import METHODS
from device.recon.model.preprocessing import Preprocessor
from device.recon.model.resolution import working_bin
from device.values import Counts, Image
from tests import scenes
from tests.hard.exposed import Exposed, exposed

PEAK_E = 15000.0
LOST = 0.002  # PCC: the noise of the stray light itself costs as much
REFRACTION_DPT = 0.1  # the standard deviation of these frames is about 0.05


def lit(eye: Exposed, light: Image) -> Counts:
    """Return the counts with stray light added, in shares of the mean light of the frame."""
    return eye.under(np.ones_like(light), light)


def background(eye: Exposed, counts: Counts) -> Image | None:
    """Return the background that the solver finds in these counts, with the PSF of the relaxed eye."""
    n = working_bin(eye.calibration.psfs[0])
    model = METHODS["variation"].model(eye.calibration, counts.shape, n, scenes.PLANNER, 0)
    return Background(Shading(model), n).fit(Preprocessor(eye.calibration, model.grid)(counts))


def gradient(shape: tuple[int, int]) -> Image:
    return np.broadcast_to(np.linspace(0, 0.6, shape[1], dtype=np.float32), shape)


def corner(shape: tuple[int, int]) -> Image:
    down, right = (np.linspace(0, 1, size, dtype=np.float32) for size in shape)
    return 0.5 * np.exp(-((down[:, None] - 0.9) ** 2 + (right - 0.9) ** 2) / (2 * 0.2**2))


def bowl(shape: tuple[int, int]) -> Image:
    down, right = (np.linspace(-1, 1, size, dtype=np.float32) for size in shape)
    return 0.3 * (down[:, None] ** 2 + right**2)


@pytest.mark.parametrize("light", [gradient, corner, bowl])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_uneven_stray_light_costs_neither_picture_nor_refraction(light, m_dpt: float) -> None:
    eye = exposed("sim", m_dpt, PEAK_E)
    clean, made = (eye.make(counts) for counts in (eye.frames[0], lit(eye, light(eye.frames[0].shape))))
    assert eye.pcc(made) > eye.pcc(clean) - LOST
    assert clean.report.refraction_dpt is not None
    assert made.report.refraction_dpt is not None
    clean_dpt = clean.report.refraction_dpt["sphere"]
    assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)


@pytest.mark.parametrize("m_dpt", [0.0, -4.0, 4.0])
def test_a_clean_frame_has_no_uneven_background(m_dpt: float) -> None:
    eye = exposed("sim", m_dpt, PEAK_E)
    assert background(eye, eye.frames[0]) is None


def test_the_found_background_is_the_added_light() -> None:
    eye = exposed("sim", 0.0, PEAK_E)
    mean_dn = float(eye.frames[0].mean()) - eye.spec.camera.black_dn
    light = gradient(eye.frames[0].shape)
    found = background(eye, lit(eye, light))
    assert found is not None
    left = (light.shape[1] - found.shape[1]) // 2  # the solver's window is the middle of the sensor
    added = light[:, left : left + found.shape[1]] * mean_dn
    apart = (found - found.mean()) - (added - added.mean())  # the constant belongs to the shading fit
    assert np.abs(apart).max() < 0.02 * np.ptp(added)


def test_on_a_sensor_that_the_disc_fills_only_a_constant_is_fitted() -> None:
    eye = exposed("imx296", 0.0, PEAK_E)
    assert background(eye, lit(eye, gradient(eye.frames[0].shape))) is None
