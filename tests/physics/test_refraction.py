"""Refraction from a frame, and the picture behind it: frames by wave propagation, of which recon knows nothing."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from device.clock import SystemClock, VirtualClock
from device.optics.diffuser import Refraction, caustic
from device.recon.geometry import disc
from device.recon.model import field_radius_px
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.recon.warp import transform, warped
from device.scene import EyeSpec
from device.sim.calibrate import simulated_calibration
from device.sim.world import World
from device.spec import load_head
from device.values import Calibration, Counts, Image, Psf

HEAD = load_head(Path(__file__).parents[2] / "hardware/heads/sim.toml")
EYES_DPT = (-5.0, 0.0, 4.0)
PEAK_E = 10_000.0
PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")


def world(m_dpt: float) -> World:
    assert HEAD.sim is not None
    sim = HEAD.sim.model_copy(update={"peak_e": PEAK_E, "eye": EyeSpec(m_dpt=m_dpt)})
    return World(HEAD.model_copy(update={"sim": sim}), VirtualClock())


@cache
def seen(m_dpt: float) -> Counts:
    eye = world(m_dpt)
    return eye.sensor.read(eye.electrons_per_s("green") * np.float32(HEAD.camera.exposure_s), (7, int(m_dpt * 10) % 99))


@cache
def relaxed() -> World:
    return world(0.0)


@pytest.fixture(scope="module")
def reconstruct() -> Reconstructor:
    """Calibrated with a relaxed eye; the closed form, so that what the PSF does is not hidden by rounds."""
    recipes = (Recipe("evidence", 4), Recipe("gradient", 2))
    return Reconstructor(simulated_calibration(relaxed()), relaxed().shape, PLANNER, SystemClock(), recipes)


def likeness(picture: Image, calibration: Calibration) -> float:
    """Pearson correlation with the truth inside the field."""
    rows, cols = relaxed().shape
    radius_px = field_radius_px(calibration)
    inside = disc((rows, cols), ((rows - 1) / 2, (cols - 1) / 2), radius_px - 3) > 0.5
    return float(np.corrcoef(picture[inside], relaxed().truth("green")[inside])[0, 1])


@pytest.mark.parametrize(
    ("eye", "pitch_um"), [(Refraction(4.0), 5.04), (Refraction(-5.0), 3.45), (Refraction(1.0, 0.75, -1.0), 5.04)]
)
def test_the_warped_psf_is_the_one_that_waves_make(eye: Refraction, pitch_um: float) -> None:
    """optics.md 2.4: 0.9995 up to 5.5 dpt; unwarped it is below 0.96."""
    assert HEAD.optics is not None
    geometry = HEAD.optics.geometry(pitch_um)
    stored, strained = (Psf(caustic(HEAD.optics, pitch_um, 1, of, 1)) for of in (Refraction(), eye))
    matrix = transform(geometry, eye.m_dpt, eye.j0_dpt, eye.j45_dpt)
    assert matrix == pytest.approx(eye.warp(HEAD.optics))
    found = warped(stored, matrix)
    assert found.pixels.sum(dtype=np.float64) == pytest.approx(1, abs=1e-5)
    assert np.corrcoef(found.pixels.ravel(), strained.pixels.ravel())[0, 1] > 0.999
    assert np.corrcoef(stored.pixels.ravel(), strained.pixels.ravel())[0, 1] < 0.96


def test_the_frame_tells_the_refraction(reconstruct: Reconstructor) -> None:
    """Over 23 frames of photographs 0.09 dpt RMS, 0.24 at most; the report gives the correction, of opposite sign."""
    errors = []
    for m_dpt in EYES_DPT:
        report = reconstruct(seen(m_dpt)).report
        assert report.refraction_dpt is not None
        assert 0.03 < report.refraction_dpt["sd"] < 0.25
        assert report.psf_scale == pytest.approx(1 - 0.003375 * m_dpt, abs=0.001)
        errors.append(report.refraction_dpt["sphere"] + m_dpt)
    assert np.sqrt(np.mean(np.square(errors))) < 0.15


def test_an_eye_out_of_focus_is_seen_as_well_as_a_relaxed_one(reconstruct: Reconstructor) -> None:
    """Within 0.3 dB, which at this likeness is 0.007 of correlation; the stored PSF alone keeps 0.88 of it."""
    focused = [likeness(reconstruct(seen(m_dpt)).picture, reconstruct.calibration) for m_dpt in EYES_DPT]
    assert min(focused) > focused[1] - 0.007
    plain = Reconstructor(
        reconstruct.calibration, reconstruct.shape, PLANNER, VirtualClock(), (Recipe("gradient", 2),), refract=False
    )
    made = plain(seen(4.0))
    assert made.report.refraction_dpt is None
    assert 0.88 * focused[1] < likeness(made.picture, plain.calibration) < 0.99 * focused[1]
    assert np.array_equal(plain(seen(0.0)).picture, reconstruct(seen(0.0)).picture)
