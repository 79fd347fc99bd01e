"""Dust on the sensor and reflexes: found as what no object explains, and left out of picture and refraction."""

import numpy as np
import pytest

from device.recon.corrections import MAX_EXPLAINED
from device.values import Image
from tests.hard.exposed import exposed

LOST = 0.01  # PCC: what was behind the spots is missing
REFRACTION_DPT = 0.15  # the standard deviation of these frames is about 0.05
DUST_SPOTS, DUST_RADIUS, DUST_SHADE = 14, 0.02, 0.35  # number, radius in heights of the sensor, share of the light


def squared_distances(shape: tuple[int, int], down: float, across: float) -> Image:
    """Return the squared distance of each pixel from a place in shares of the sensor, in heights of the sensor."""
    rows, cols = (np.arange(size, dtype=np.float32) - at * size for size, at in zip(shape, (down, across), strict=True))
    return np.asarray((rows[:, None] ** 2 + cols**2) / shape[0] ** 2, np.float32)


def dust(shape: tuple[int, int], seed: int) -> Image:
    share = np.ones(shape, np.float32)
    for down, across in np.random.default_rng(seed).uniform(0.05, 0.95, (DUST_SPOTS, 2)):
        share[squared_distances(shape, down, across) < DUST_RADIUS**2] *= np.float32(1 - DUST_SHADE)
    return share


@pytest.mark.parametrize(("head", "peak_e"), [("sim", 15000.0), ("imx296", 8000.0)])
@pytest.mark.parametrize("m_dpt", [0.0, -4.0])
def test_dust_costs_neither_picture_nor_refraction_and_is_told(head: str, peak_e: float, m_dpt: float) -> None:
    eye = exposed(head, m_dpt, peak_e)
    shape = eye.spec.camera.rows, eye.spec.camera.cols
    clean = eye.make(eye.frames[0])
    made = eye.make(eye.under(dust(shape, 3), np.zeros(shape, np.float32)))
    assert "spots" not in clean.report.quality
    assert made.report.residual is not None
    assert made.report.residual < MAX_EXPLAINED
    assert eye.pcc(made) > eye.pcc(clean) - LOST
    assert [warning for warning in made.report.warnings if "Dark spots" in warning]
    assert clean.report.refraction_dpt is not None
    assert made.report.refraction_dpt is not None
    clean_dpt = clean.report.refraction_dpt["sphere"]
    assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT)


def test_a_reflex_that_is_not_clipped_is_left_out_without_a_word_of_dust() -> None:
    eye = exposed("sim", 0.0, 15000.0)
    shape = eye.spec.camera.rows, eye.spec.camera.cols
    reflex = np.asarray(squared_distances(shape, 0.45, 0.55) < 0.05**2, np.float32)
    clean, made = (eye.make(eye.under(np.ones(shape, np.float32), np.float32(light) * reflex)) for light in (0.0, 0.6))
    assert eye.pcc(made) > eye.pcc(clean) - LOST
    assert 0 < made.report.quality["spots"] < 0.1
    assert made.report.warnings == clean.report.warnings
