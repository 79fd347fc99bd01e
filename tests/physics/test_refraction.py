"""Refraction estimate and picture of wave-propagated frames, which share no operator with the solver."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from device.clock import SystemClock, VirtualClock
from device.config.head_file import load_head
from device.config.scene import EyeSpec
from device.optics.diffuser import Refraction as Wavefront
from device.optics.diffuser import caustic
from device.recon.estimation.psf_warp import transform, warped
from device.recon.estimation.refraction.estimator import NoRefraction, Refraction, RefractionEstimator
from device.recon.frame_run import EyePsf
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.grid import disc
from device.recon.model.kernels import Pixels
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Counts, Image, Psf, Reconstruction
from tests.simulated import coarse, with_keys
from tests.simulated import world as decided

HEAD = load_head(Path(__file__).parents[2] / "hardware/heads/sim.toml")
EYES_DPT = (-5.0, 0.0, 4.0)
PEAK_E = 10_000.0
PLANNER = Planner(folder=None, effort="FFTW_ESTIMATE")


def world(m_dpt: float) -> World:
    assert HEAD.sim is not None
    sim = HEAD.sim.model_copy(update={"peak_e": PEAK_E, "eye": EyeSpec(m_dpt=m_dpt)})
    return World(HEAD.model_copy(update={"sim": sim}), VirtualClock())


@cache
def counts_of(m_dpt: float) -> Counts:
    eye = world(m_dpt)
    return eye.sensor.read(eye.electrons_per_s("green") * np.float32(HEAD.camera.exposure_s), (7, int(m_dpt * 10) % 99))


@cache
def relaxed() -> World:
    return world(0.0)


@pytest.fixture(scope="module")
def reconstruct() -> Reconstructor:
    """Reconstructor calibrated with a relaxed eye; a closed form, so that no iteration hides the effect of the PSF."""
    recipes = (Recipe("evidence", 4), Recipe("gradient", 2))
    return Reconstructor(simulated_calibration(relaxed()), relaxed().shape, PLANNER, SystemClock(), recipes)


def pcc(picture: Image, calibration: Calibration) -> float:
    """Return the Pearson correlation with the truth inside the field."""
    rows, cols = relaxed().shape
    radius_px = field_radius_px(calibration)
    inside = disc((rows, cols), ((rows - 1) / 2, (cols - 1) / 2), radius_px - 3) > 0.5
    return float(np.corrcoef(picture[inside], relaxed().truth("green")[inside])[0, 1])


@pytest.mark.parametrize(
    ("eye", "pitch_um"), [(Wavefront(4.0), 5.04), (Wavefront(-5.0), 3.45), (Wavefront(1.0, 0.75, -1.0), 5.04)]
)
def test_the_warped_psf_agrees_with_wave_propagation(eye: Wavefront, pitch_um: float) -> None:
    """OPTICS.md 2.6: 0.9995 up to 5.5 dpt; unwarped it is below 0.96."""
    assert HEAD.optics is not None
    geometry = HEAD.optics.geometry(pitch_um)
    stored, strained = (Psf(caustic(HEAD.optics, pitch_um, 1, of, 1)) for of in (Wavefront(), eye))
    matrix = transform(geometry, eye.m_dpt, eye.j0_dpt, eye.j45_dpt)
    assert matrix == pytest.approx(eye.warp(HEAD.optics))
    found = warped(stored, matrix)
    assert found.pixels.sum(dtype=np.float64) == pytest.approx(1, abs=1e-5)
    assert np.corrcoef(found.pixels.ravel(), strained.pixels.ravel())[0, 1] > 0.999
    assert np.corrcoef(stored.pixels.ravel(), strained.pixels.ravel())[0, 1] < 0.96


def test_the_refraction_is_estimated_from_the_frame(reconstruct: Reconstructor) -> None:
    """The report gives the correction, of opposite sign to the wavefront; its sd is that of the refinement."""
    errors = []
    for m_dpt in EYES_DPT:
        report = reconstruct(counts_of(m_dpt)).report
        assert report.refraction_dpt is not None
        assert 0.03 < report.refraction_dpt["sd"] < 0.15
        assert report.psf_scale == pytest.approx(1 - 0.003375 * m_dpt, abs=0.001)
        errors.append(report.refraction_dpt["sphere"] + m_dpt)
    assert np.sqrt(np.mean(np.square(errors))) < 0.15


def test_an_eye_out_of_focus_is_reconstructed_as_well_as_a_relaxed_one(reconstruct: Reconstructor) -> None:
    """At most 0.3 dB lost, 0.007 of correlation here; the stored PSF alone keeps 0.88 of the correlation."""
    focused = [pcc(reconstruct(counts_of(m_dpt)).picture, reconstruct.calibration) for m_dpt in EYES_DPT]
    assert min(focused) > focused[1] - 0.007
    plain = Reconstructor(
        reconstruct.calibration, reconstruct.shape, PLANNER, VirtualClock(), (Recipe("gradient", 2),), refract=False
    )
    made = plain(counts_of(4.0))
    assert made.report.refraction_dpt is None
    assert 0.88 * focused[1] < pcc(made.picture, plain.calibration) < 0.99 * focused[1]
    assert np.array_equal(plain(counts_of(0.0)).picture, reconstruct(counts_of(0.0)).picture)


def test_a_picture_with_the_stored_psf_is_not_that_with_the_psf_of_the_eye_before(reconstruct: Reconstructor) -> None:
    before = reconstruct(counts_of(0.0))
    assert before.report.refraction_dpt is not None
    reconstruct(counts_of(4.0))
    *_, made = reconstruct.steps(counts_of(4.0), eye_psf=EyePsf.STORED)
    assert isinstance(made, Reconstruction)
    assert (made.report.psf_scale, made.report.refraction_dpt) == (1.0, None)
    plain = Reconstructor(
        reconstruct.calibration, reconstruct.shape, PLANNER, VirtualClock(), (Recipe("gradient", 2),), refract=False
    )
    assert np.array_equal(made.picture, plain(counts_of(4.0)).picture)


@pytest.fixture(scope="module")
def dim() -> World:
    """A relaxed eye on pixels of 20 um in so little light that the noise of dark ones does not dither their counts."""
    return decided(coarse(with_keys(HEAD, peak_e=500.0), 4))


@pytest.fixture(scope="module")
def of_dim(dim: World) -> RefractionEstimator:
    return RefractionEstimator(simulated_calibration(dim), dim.shape, PLANNER, 0)


def dim_counts(dim: World, seed: int) -> Counts:
    return dim.sensor.read(dim.electrons_per_s("green") * np.float32(HEAD.camera.exposure_s), (11, seed))


def refined(of: RefractionEstimator, counts: Pixels) -> Refraction:
    """Return the refraction of a frame with its cylinder, which is refined on the frame itself."""
    found = of.find(counts, None, of.defects(counts, None))
    assert not isinstance(found, NoRefraction)
    with_cylinder = of.add_cylinder(found)
    assert not isinstance(with_cylinder, NoRefraction)
    return with_cylinder


def test_little_light_does_not_shift_the_refraction(dim: World, of_dim: RefractionEstimator) -> None:
    """Samples that were weighted and chosen by their own noise shifted each of these frames by 0.23 dioptres."""
    found = [refined(of_dim, dim_counts(dim, seed)) for seed in range(4)]
    sd_dpt = float(np.mean([refraction.sd_dpt for refraction in found]))
    # 2.5: the mean of four frames is beyond it once in a hundred times
    assert abs(np.mean([refraction.m_dpt for refraction in found])) < 2.5 * sd_dpt / np.sqrt(len(found))


def test_whole_numbers_in_a_float_frame_are_rounded_counts(dim: World, of_dim: RefractionEstimator) -> None:
    """A frame with missing pixels is a float frame; its dark samples are read as 0 all the same."""
    counts = dim_counts(dim, 0)
    whole, rounded = refined(of_dim, counts), refined(of_dim, counts.astype(np.float32))
    assert (rounded.m_dpt, rounded.sd_dpt) == pytest.approx((whole.m_dpt, whole.sd_dpt), abs=1e-6)
