"""PSF warp: two independent computations of the OTF of a stretched PSF, and models with exchanged OTFs."""

import numpy as np
import pytest

from device.clock import VirtualClock
from device.errors import SettingError
from device.recon.estimation.psf_warp import InterpolatedOtf, Wavefront, picture_otf, transform, warped
from device.recon.estimation.refraction.estimator import NoRefraction, RefractionEstimator
from device.recon.estimation.shading import Shading
from device.recon.model.forward_model import Model, otf
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Linear
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.values import Geometry, Psf, Sensor
from tests import scenes

SHAPE = (160, 192)
GEOMETRY = Geometry(pitch_um=20.16, diffuser_to_sensor_um=6000, angular_magnification=0.75)
PSF = Psf(scenes.speckle(SHAPE, seed=3, grain_px=2.0))
EYES = [(4.0, 0.0, 0.0), (-7.0, 0.0, 0.0), (2.0, 1.5, -2.0)]


def spot_psf(row: int, col: int) -> Psf:
    pixels = np.zeros((201, 201), np.float32)
    rows, cols = np.mgrid[:201, :201]
    pixels[:] = np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 18)
    return Psf(pixels)


def centroid_px(psf: Psf) -> np.ndarray:
    return np.array([(psf.pixels * grid).sum() for grid in np.mgrid[:201, :201]]) - 100


def test_a_point_moves_by_the_matrix() -> None:
    matrix = transform(GEOMETRY, 6.0, 2.0, -3.0)
    down, across = centroid_px(warped(spot_psf(40, 150), matrix))
    assert (across, down) == pytest.approx(tuple(matrix @ [50, -60]), abs=0.01)


def test_zero_refraction_does_not_stretch() -> None:
    assert warped(PSF, transform(GEOMETRY, 0.0)).pixels == pytest.approx(PSF.pixels, abs=1e-7)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("n", [2, 3])
def test_interpolated_otf_is_the_otf_of_the_stretched_psf(eye: tuple[float, float, float], n: int) -> None:
    """2 %: the interpolation error is 0.7 % per axis at the PSF's edge; splines blur finer structure than n = 2."""
    matrix = transform(GEOMETRY, *eye)
    grid = Grid.tight(SHAPE, n, 50.0, 60.0)
    looked_up, transformed = InterpolatedOtf(PSF).on_grid(grid.shape, n, matrix), otf(warped(PSF, matrix), grid)
    assert warped(PSF, matrix).pixels.sum() == pytest.approx(1, abs=1e-5)
    assert looked_up[0, 0] == pytest.approx(1, abs=1e-4)
    assert np.linalg.norm(looked_up - transformed) < 0.02 * np.linalg.norm(transformed)
    assert np.linalg.norm(otf(PSF, grid) - transformed) > 0.1 * np.linalg.norm(transformed)


def test_the_otf_of_a_picture_keeps_the_light_beyond_the_support_and_is_the_stored_one_for_no_stretch() -> None:
    """The support holds all but 0.3 % of the light; here a halo of 1 % of it goes on to the border."""
    psf = Psf(PSF.pixels + np.float32(0.01 * PSF.pixels.mean()))
    interpolated, model = InterpolatedOtf(psf), Model(psf, Grid.tight(SHAPE, 2, 50.0, 60.0), scenes.PLANNER)
    still = interpolated.on_grid(model.grid.shape, 2, np.eye(2))
    stored, stretch = picture_otf(interpolated, model, np.eye(2)), transform(GEOMETRY, *EYES[2])
    assert stored == pytest.approx(model.stored, abs=1e-6)
    assert np.abs(still - model.stored).max() > 1e-3
    moved = picture_otf(interpolated, model, stretch) - model.stored
    assert moved == pytest.approx(interpolated.on_grid(model.grid.shape, 2, stretch) - still, abs=1e-6)


def test_shading_is_recovered_before_and_after_a_change_of_psf() -> None:
    """The modes are blurred on blocks; the frame of this test is blurred sample by sample."""
    model = Model(PSF, Grid.tight(SHAPE, 1, 60.0, 55.0), scenes.PLANNER)
    shading = Shading(model)
    rows, cols = (np.arange(size) - middle for size, middle in zip(model.grid.shape, model.grid.centre, strict=True))
    shaded = (model.mask * (100 + 0.4 * rows[:, None] - 0.005 * cols[None] ** 2)).astype(np.float32)
    found = np.zeros_like(shaded)
    for m_dpt in (0.0, 8.0):
        model.refocus(InterpolatedOtf(PSF).on_grid(model.grid.shape, 1, transform(GEOMETRY, m_dpt)))
        shading.refocus()
        window = np.ascontiguousarray(model.blur(shaded)[model.grid.slices])
        shading.fit(Linear(window, np.ones_like(window), float(window.mean()), 0.0, 0.0), found)
        assert np.sqrt(np.mean((found - shaded)[model.mask > 0.5] ** 2)) < 0.4  # of 100


@pytest.mark.parametrize("method", ["tikhonov", "gradient", "evidence", "variation"])
def test_restoring_the_stored_otf_restores_the_picture(method: str) -> None:
    cal = scenes.calibration(PSF.pixels, geometry=GEOMETRY, field_deg=20.0)
    reconstruct = Reconstructor(cal, SHAPE, scenes.PLANNER, VirtualClock(), (Recipe(method, 1),))
    counts = np.random.default_rng(0).integers(500, 600, SHAPE).astype(np.uint16)
    stage, before = reconstruct.stages[0], reconstruct(counts, rounds=2).picture
    assert reconstruct.refractor is not None
    eye = Wavefront(6.0, 1.0, -0.5)
    stage.refocus(reconstruct.refractor.otf(stage.model, eye), eye)
    assert (stage.eye, stage.model.otf is stage.model.stored) == (eye, False)
    assert np.array_equal(reconstruct(counts, rounds=2).picture, before)


def test_a_frame_without_structure_has_no_refraction() -> None:
    cal = scenes.calibration(PSF.pixels, geometry=GEOMETRY, field_deg=20.0, sensor=Sensor(gain_e_per_dn=5.0))
    refractor = RefractionEstimator(cal, SHAPE, scenes.PLANNER, 0)
    assert isinstance(refractor.find(np.zeros(SHAPE, np.uint16)), NoRefraction)
    noise = (np.random.default_rng(1).poisson(2500, SHAPE) // 5).astype(np.uint16)
    assert isinstance(refractor.find(noise), NoRefraction)


def test_refraction_is_refused_without_geometry_or_field() -> None:
    cal = scenes.calibration(PSF.pixels)
    with pytest.raises(SettingError):
        RefractionEstimator(cal, SHAPE, scenes.PLANNER, 0)
    report = scenes.reconstructor(cal, SHAPE)(np.full(SHAPE, 700, np.uint16)).report
    assert (report.refraction_dpt, report.psf_scale) == (None, 1.0)
