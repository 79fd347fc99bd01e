"""Bounds from theory (NUMERICS.md 3.5) and measured figures, and extreme inputs for every solver.

`within(measured, bound)` asserts the bound and three times the recorded figure (`conftest.py`); the README's table
contains the recorded figures.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.recon.reconstructor import Reconstructor
from device.recon.solvers.wiener import TIKHONOV, ClosedForm
from device.recon.stage import Recipe
from device.values import Image, Psf, Sensor
from tests import scenes

SHAPE = (96, 128)
METHODS = ("tikhonov", "gradient", "evidence", "variation", "open")
CROP_AWARE = METHODS[2:]
U32 = 2.0**-24
Within = Callable[[float, float], None]


@cache
def psf(seed: int = 0) -> Image:
    return scenes.speckle(SHAPE, seed)


def otf(image: Image) -> np.ndarray:
    return np.fft.rfft2(np.fft.ifftshift(image.astype(np.float64)))


def blurred(scene: np.ndarray, image: Image) -> np.ndarray:
    return np.fft.irfft2(np.fft.rfft2(scene) * otf(image), SHAPE)


def scene(seed: int = 1, level: float = 2000.0) -> np.ndarray:
    """Return a bright field with darker bars and a brighter square: positive, with edges."""
    rng = np.random.default_rng(seed)
    x = np.full(SHAPE, level)
    for col in range(20, 110, 18):
        x[20:76, col : col + 5] *= rng.uniform(0.4, 0.9)
    x[40:55, 50:75] *= 1.6
    return x


def frame(seed: int = 1, image: Image | None = None, level: float = 2000.0) -> np.ndarray:
    seen = blurred(scene(seed, level), psf() if image is None else image)
    return np.random.default_rng(seed + 100).poisson(np.maximum(seen, 0)).astype(np.float32)


def reconstructor_of(method: str, image: Image | None = None, **changes: object) -> Reconstructor:
    calibration = scenes.calibration(psf() if image is None else image, **changes)
    make = scenes.reconstructor(calibration, SHAPE, Recipe(method, 1))
    if method == "tikhonov":
        make.stages[0].model.fade = None  # as in the paper: periodic, without a taper
    return make


def pcc(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def tikhonov(mu: float, image: Image | None = None) -> Callable[[np.ndarray], np.ndarray]:
    make = reconstructor_of("tikhonov", image)
    make.stages[0].solver = ClosedForm(make.stages[0].model, TIKHONOV, mu)
    return lambda y: make(y.astype(np.float32)).picture.astype(np.float64)


def float64_solution(y: np.ndarray, mu: float, image: Image) -> np.ndarray:
    """Return the float64 reference: conj(H) Y / (|H|^2 + mu)."""
    H = otf(image)
    return np.fft.irfft2(np.conj(H) * np.fft.rfft2(y) / (np.abs(H) ** 2 + mu), SHAPE)


# The closed form: NUMERICS.md 3.5, items 1 to 13


@pytest.mark.parametrize("mu", [1e-2, 1e-4, 1e-6])
def test_1_norms_are_limited_by_the_largest_gain(mu: float, within: Within) -> None:
    solve, (a, b) = tikhonov(mu), (frame(1), frame(2))
    gain = 1 / (2 * np.sqrt(mu))
    within(float(np.linalg.norm(solve(a)) / (gain * np.linalg.norm(a))), 1 + 1e-4)
    within(float(np.linalg.norm(solve(a) - solve(b)) / (gain * np.linalg.norm(a - b))), 1 + 1e-4)


def test_3_error_of_one_bad_pixel_is_that_of_the_filter(within: Within) -> None:
    mu, y = 1e-4, frame()
    broken = y.copy()
    broken[40, 60] += 500
    change = tikhonov(mu)(broken) - tikhonov(mu)(y)
    H2 = np.abs(np.fft.fft2(np.fft.ifftshift(psf().astype(np.float64)))) ** 2
    filter_rms = float(np.sqrt((H2 / (H2 + mu) ** 2).mean()))
    within(abs(np.linalg.norm(change) / (500 * filter_rms) - 1), 2e-3)
    within(float(np.abs(change).max() / (500 * (np.sqrt(H2) / (H2 + mu)).mean())), 1.001)


@pytest.mark.parametrize("mu", [1e-2, 1e-3])
def test_4_error_of_a_wrong_psf_is_limited_by_its_otf_error(mu: float, within: Within) -> None:
    right, wrong = psf(), (0.98 * psf() + 0.02 * psf(5)).astype(np.float32)
    x = scene()
    y = blurred(x, right)
    change = tikhonov(mu, wrong)(y) - tikhonov(mu, right)(y)
    error = float(np.abs(otf(wrong) - otf(right)).max())
    within(float(np.linalg.norm(change) / (1.150 * error * np.linalg.norm(x) / np.sqrt(mu))), 1.0)
    within(float(np.linalg.norm(change) / (error * np.linalg.norm(y) / mu)), 1.0)


@pytest.mark.parametrize(("beta", "loss"), [(0.006, 0.01), (0.05, 0.12)])
def test_6_background_in_the_psf_changes_mu_and_scale(beta: float, loss: float, within: Within) -> None:
    """Without the mean, the solution is (1 + beta) times that with (1 + beta)^2 mu."""
    mu, y = 1e-4, frame()
    image = psf().astype(np.float64)
    hazy = ((image + beta / image.size) / (1 + beta)).astype(np.float32)
    plain = tikhonov((1 + beta) ** 2 * mu)(y) * (1 + beta)
    with_haze = tikhonov(mu, hazy)(y)
    a, b = with_haze - with_haze.mean(), plain - plain.mean()
    within(float(np.linalg.norm(a - b) / np.linalg.norm(b)), 1e-3)
    within(pcc(tikhonov(mu)(y), scene()) - pcc(with_haze, scene()), loss)


@pytest.mark.parametrize("mu", [1e-3, 0.1])
def test_7_constant_frame_gives_the_constant_of_theory(mu: float, within: Within) -> None:
    x = tikhonov(mu)(np.full(SHAPE, 700.0))
    within(float(np.abs(x / (700 / (1 + mu)) - 1).max()), 1e-4)


@given(st.floats(0.01, 15), st.floats(-5, -1))
@settings(max_examples=15, deadline=None)
def test_8_solution_is_linear_in_the_light(factor: float, log_mu: float) -> None:
    solve, y = tikhonov(10**log_mu), frame()
    assert np.linalg.norm(solve(factor * y) - factor * solve(y)) <= 1e-4 * factor * np.linalg.norm(solve(y))


def test_9_more_prior_is_a_smaller_picture_and_a_larger_misfit() -> None:
    y = frame().astype(np.float64)
    pictures = [tikhonov(mu)(y) for mu in 10.0 ** np.arange(-8, 3)]
    sizes = [float(np.linalg.norm(x)) for x in pictures]
    misfits = [float(np.linalg.norm(y - blurred(x, psf()))) for x in pictures]
    assert sizes == sorted(sizes, reverse=True)
    assert misfits == sorted(misfits)
    assert sizes[-1] < 0.02 * np.linalg.norm(y)
    assert misfits[-1] == pytest.approx(np.linalg.norm(y), rel=0.02)


@pytest.mark.parametrize("mu", [1e-2, 1e-4, 1e-6, 1e-8])
def test_10_single_precision_error_is_within_theory(mu: float, within: Within) -> None:
    y = frame()
    error = np.linalg.norm(tikhonov(mu)(y) - float64_solution(y, mu, psf())) / np.linalg.norm(y)
    within(float(error / (U32 / (2 * np.sqrt(mu)))), 4.0)


def test_13_a_long_run_of_rounds_does_not_drift(within: Within) -> None:
    """The picture of round 200 is that of round 40."""
    make = scenes.reconstructor(scenes.calibration(psf()), SHAPE, Recipe("variation", 1, 200))
    y = frame()
    early, late = (make(y, rounds=rounds).picture.astype(np.float64) for rounds in (40, 200))
    within(float(np.linalg.norm(late - early) / np.linalg.norm(early)), 0.05)


# Extreme inputs, for every solver


@pytest.mark.parametrize("mu", [1e-2, 1e-4])
def test_missing_pixels_change_tikhonov_by_at_most_its_gain(mu: float, within: Within) -> None:
    """`tikhonov` has no model of a gap: masked pixels read zero and cause ringing, with a bound."""
    y, bad = frame(), np.zeros(SHAPE, np.bool_)
    bad[:, 41] = bad[17] = bad[50:54, 60:64] = True
    make = reconstructor_of("tikhonov", bad=bad)
    make.stages[0].solver = ClosedForm(make.stages[0].model, TIKHONOV, mu)
    change = make(y).picture - tikhonov(mu)(y)
    within(float(np.linalg.norm(change) / (np.linalg.norm(y[bad]) / (2 * np.sqrt(mu)))), 1.0)


@pytest.mark.parametrize("method", METHODS[1:])
def test_dead_rows_and_columns_do_not_change_the_picture(method: str, within: Within) -> None:
    clean = frame()
    broken, bad = clean.copy(), np.zeros(SHAPE, np.bool_)
    bad[:, 41] = bad[17] = True
    broken[bad] = 60000
    masked, plain = reconstructor_of(method, bad=bad)(broken).picture, reconstructor_of(method)(clean).picture
    within(1 - pcc(masked, plain), 0.02)


@pytest.mark.parametrize("method", METHODS[1:])
def test_five_per_cent_saturated_are_masked(method: str, within: Within) -> None:
    """The error of the picture with masked pixels, over its error with unmasked ones."""
    full, bright = frame(), np.random.default_rng(6).random(SHAPE) < 0.05
    full[bright] = 20000
    clean = reconstructor_of(method)(frame()).picture.copy()
    masked, unmasked = (
        reconstructor_of(method, sensor=Sensor(white_dn=white))(full).picture for white in (20000.0, 65535.0)
    )
    within(float(np.linalg.norm(masked - clean) / np.linalg.norm(unmasked - clean)), 0.1)


@pytest.mark.parametrize("method", METHODS[1:])
def test_a_tenth_of_the_pixels_missing_costs_less_than_a_tenth(method: str, within: Within) -> None:
    bad = np.random.default_rng(4).random(SHAPE) < 0.1
    broken = frame()
    broken[bad] = np.nan
    within(1 - pcc(reconstructor_of(method)(broken).picture, reconstructor_of(method)(frame()).picture), 0.1)


@pytest.mark.parametrize("method", METHODS)
def test_a_psf_that_is_a_point_gives_the_frame_back(method: str, within: Within) -> None:
    y = scene().astype(np.float32)
    x = reconstructor_of(method, scenes.delta(SHAPE))(y).picture
    within(float(np.linalg.norm(x - y) / np.linalg.norm(y)), 0.1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("level", [1e-3, 1e9])
def test_counts_of_any_magnitude_give_finite_pictures(method: str, level: float) -> None:
    y = (frame() / 2000 * level).astype(np.float32)
    picture = reconstructor_of(method, sensor=Sensor(white_dn=1e12))(y).picture
    assert np.isfinite(picture).all()
    assert picture.mean() == pytest.approx(y.mean(), rel=0.1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kernel", ["box", "double", "comb"])
def test_zeros_in_the_otf_leave_the_picture_no_larger_than_the_object(method: str, kernel: str, within: Within) -> None:
    image = np.zeros(SHAPE, np.float32)
    middle = SHAPE[0] // 2, SHAPE[1] // 2
    if kernel == "box":
        image[middle[0] - 4 : middle[0] + 4, middle[1] - 6 : middle[1] + 6] = 1
    elif kernel == "double":
        image[middle] = image[middle[0], middle[1] + 10] = 1
    else:
        image[middle[0], middle[1] - 30 : middle[1] + 31 : 6] = 1
    image /= image.sum()
    x = reconstructor_of(method, image)(frame(image=image)).picture
    within(float(np.linalg.norm(x - x.mean()) / np.linalg.norm(scene() - scene().mean())), 1.5)


# No detail without data


@pytest.mark.parametrize("method", METHODS)
def test_objects_that_differ_in_the_null_space_give_one_picture(method: str, within: Within) -> None:
    """A wave at a zero of a box's OTF does not change the frame, so it must not change the picture."""
    image = np.zeros(SHAPE, np.float32)
    image[SHAPE[0] // 2, SHAPE[1] // 2 - 4 : SHAPE[1] // 2 + 4] = 1 / 8  # zeros every 16 cycles of 128
    wave = 300 * np.cos(2 * np.pi * 32 * np.arange(SHAPE[1]) / SHAPE[1])[None, :] * np.ones(SHAPE)
    noise = np.random.default_rng(9).normal(0, 20, SHAPE)
    plain, waved = (blurred(scene() + extra, image) + noise for extra in (0, wave))
    make = reconstructor_of(method, image)
    before, after = (make(y.astype(np.float32)).picture.copy() for y in (plain, waved))
    within(float(np.linalg.norm(before - after) / np.linalg.norm(wave)), 1e-3)
    wave_share = abs(np.vdot(after, wave)) / np.vdot(wave, wave)
    within(float(wave_share), 0.1)  # share of the wave, which is in the object and not in the frame


@pytest.mark.parametrize("method", CROP_AWARE)
def test_pure_noise_gives_little_detail(method: str, within: Within) -> None:
    """Even light with shot noise gives detail of a few per cent of the brightness."""
    y = np.random.default_rng(3).poisson(2000, SHAPE).astype(np.float32)
    x = reconstructor_of(method)(y).picture
    within(float(x.std() / x.mean()), 0.1)


@pytest.mark.parametrize("method", METHODS)
def test_frame_through_another_psf_keeps_its_brightness(method: str, within: Within) -> None:
    y = frame(image=psf(7))
    x = reconstructor_of(method)(y).picture
    within(abs(float(x.mean()) / float(y.mean()) - 1), 0.05)
    if method in CROP_AWARE:
        within(float(x.std() / scene().std()), 2.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shift", [(0, 0), (7, -11)])
def test_shifted_or_rotated_psf_gives_the_same_quality(method: str, shift: tuple[int, int], within: Within) -> None:
    turned = np.roll(psf()[::-1, ::-1], shift, (0, 1)).astype(np.float32)
    x = reconstructor_of(method, turned)(frame(image=turned)).picture
    again = reconstructor_of(method)(frame()).picture
    within(abs(pcc(x, scene()) - pcc(again, scene())), 0.05)


def test_finite_psf_is_normalised() -> None:
    assert Psf(psf(), "good").pixels.sum() == pytest.approx(1, rel=1e-5)
