"""Difficult frames and PSFs, each with a bound on the picture."""

import numpy as np
import pytest

from device.errors import FrameError, PsfError, SettingError
from device.recon.stage import Recipe
from device.values import Psf, Sensor
from tests import scenes

SHAPE = (60, 84)
METHODS = ("tikhonov", "gradient", "evidence", "variation", "open")


def frame(level: float = 2000.0, seed: int = 1) -> np.ndarray:
    scene = np.full(SHAPE, float(level))
    scene[20:35, 30:50] *= 1.5
    H = np.fft.rfft2(np.fft.ifftshift(scenes.speckle(SHAPE)))
    y = np.fft.irfft2(np.fft.rfft2(scene) * H, SHAPE)
    return np.random.default_rng(seed).poisson(np.maximum(y, 0)).astype(np.uint16)


def made(counts: np.ndarray, method: str, **changes: object) -> np.ndarray:
    cal = scenes.calibration(scenes.speckle(SHAPE), **changes)
    return scenes.reconstructor(cal, SHAPE, Recipe(method, 1))(counts).picture


@pytest.mark.parametrize("method", METHODS)
def test_a_black_frame_is_black(method: str) -> None:
    result = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, Recipe(method, 1))(
        np.zeros(SHAPE, np.uint16)
    )
    assert not result.picture.any()
    assert result.report.warnings == ("There is no signal in this frame.",)


def test_a_constant_frame_is_the_same_constant() -> None:
    assert made(np.full(SHAPE, 777, np.uint16), "gradient") == pytest.approx(777, rel=1e-4)


@pytest.mark.parametrize("method", METHODS[1:])  # tikhonov has a separate bound in test_bounds.py
def test_a_saturated_blob_is_masked(method: str) -> None:
    clean = frame()
    blob = clean.copy()
    blob[10:14, 10:14] = 4095
    with_blob = made(blob, method, sensor=Sensor(white_dn=4095.0))
    without = made(clean, method, sensor=Sensor(white_dn=4095.0))
    unmasked = made(blob, method, sensor=Sensor(white_dn=65535.0))
    assert np.linalg.norm(with_blob - without) < 0.5 * np.linalg.norm(unmasked - without)
    assert np.isfinite(with_blob).all()


def test_too_much_saturation_is_refused_with_a_remedy() -> None:
    with pytest.raises(FrameError, match="cannot be used") as caught:
        made(np.full(SHAPE, 4095, np.uint16), "gradient", sensor=Sensor(white_dn=4095.0))
    assert "Too bright" in caught.value.remedy


def test_dead_rows_and_columns_change_the_picture_little() -> None:
    clean = frame()
    broken = clean.copy()
    bad = np.zeros(SHAPE, np.bool_)
    bad[:, 41] = bad[17] = True
    broken[bad] = 65535
    masked, plain = made(broken, "gradient", bad=bad), made(clean, "gradient")
    assert np.corrcoef(masked.ravel(), plain.ravel())[0, 1] > 0.9


def test_nan_in_a_float_frame_dark_or_flat_is_a_missing_pixel() -> None:
    y = frame().astype(np.float32)
    y[5, 5] = np.nan
    dark, flat = np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.float32)
    dark[6, 6], flat[7, 7] = np.inf, np.nan
    picture = made(y, "gradient", dark_dn=dark, flat=flat)
    assert np.isfinite(picture).all()
    assert picture.mean() == pytest.approx(float(np.nanmean(y)), rel=0.02)


def test_negative_values_after_dark_subtraction_are_kept() -> None:
    noise = np.random.default_rng(0).normal(100, 5, SHAPE).astype(np.float32)
    assert abs(made(noise, "gradient", sensor=Sensor(black_dn=100.0)).mean()) < 1  # clipping at 0 would give about +2


@pytest.mark.parametrize("values", [np.nan, np.inf, 0.0, -1.0])
def test_an_invalid_psf_is_refused(values: float) -> None:
    with pytest.raises(PsfError):
        Psf(np.full((8, 8), values, np.float32), "wrong")


@pytest.mark.parametrize("shape", [(1, 64), (64, 1), (7, 11), (31, 37), (3, 2), (1, 1)])
@pytest.mark.parametrize("method", METHODS)
def test_odd_prime_and_one_pixel_wide_frames_are_bounded(shape: tuple[int, int], method: str) -> None:
    y = np.random.default_rng(2).integers(100, 200, shape).astype(np.uint16)
    result = scenes.reconstructor(scenes.calibration(scenes.delta(shape)), shape, Recipe(method, 1))(y)
    assert result.picture.shape == shape
    assert np.abs(result.picture).max() <= 2 * 200


@pytest.mark.parametrize("level", [1, 10, 1e3, 4e4])
def test_the_mean_is_kept_from_one_count_to_a_full_sensor(level: float) -> None:
    assert made(frame(level), "gradient").mean() == pytest.approx(frame(level).mean(), rel=0.02, abs=0.02)


@pytest.mark.parametrize("mu", [1e-10, 1e-6, 1.0, 1e12])
def test_extreme_weights_of_the_prior_give_finite_pictures(mu: float) -> None:
    from device.recon.solvers.wiener import GRADIENT, ClosedForm

    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, Recipe("gradient", 1))
    reconstruct.stages[0].solver = ClosedForm(reconstruct.stages[0].model, GRADIENT, mu)
    assert np.isfinite(reconstruct(frame()).picture).all()


@pytest.mark.parametrize("mu", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_weight_of_the_prior_is_refused(mu: float) -> None:
    from device.recon.solvers.wiener import GRADIENT, ClosedForm

    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE, Recipe("gradient", 1))
    with pytest.raises(SettingError, match="mu"):
        ClosedForm(reconstruct.stages[0].model, GRADIENT, mu)


def test_another_shape_is_refused() -> None:
    reconstruct = scenes.reconstructor(scenes.calibration(scenes.speckle(SHAPE)), SHAPE)
    with pytest.raises(FrameError, match="pixels"):
        reconstruct(np.zeros((10, 10), np.uint16))


def test_most_of_the_sensor_marked_bad_is_refused() -> None:
    with pytest.raises(FrameError, match="marked bad"):
        made(frame(), "gradient", bad=np.ones(SHAPE, np.bool_))
