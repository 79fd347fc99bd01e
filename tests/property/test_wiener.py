"""Closed-form deconvolution: comparison with the textbook version, and identities of linear filters."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device.recon.model.forward_model import otf, periodic_model, wrapped
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Preprocessor
from device.recon.solvers.wiener import GRADIENT, TIKHONOV, ClosedForm, Prior
from device.values import Image, Psf
from tests import scenes
from tests.textbook import deconvolution as textbook

SIZES = st.sampled_from([7, 8, 13, 16, 31, 48])
SEEDS = st.integers(0, 2**16)


def solved(psf: Image, y: Image, prior: Prior, mu: float, **changes: object) -> Image:
    cal = scenes.calibration(psf, **changes)
    model = periodic_model(cal, y.shape, 1, scenes.PLANNER, 0)
    model.fade = None
    solver = ClosedForm(model, prior, mu)
    solver.start(Preprocessor(cal, model.grid)(y))
    out = np.zeros(model.grid.shape, np.float32)
    solver.finish(out)
    return out


def scene(rows: int, cols: int, seed: int) -> tuple[Image, Image]:
    y = np.random.default_rng(seed).uniform(0, 1000, (rows, cols)).astype(np.float32)
    return scenes.speckle((rows, cols), seed), y


@given(SIZES, SIZES, SEEDS, st.floats(-6, 1))
@settings(max_examples=40, deadline=None)
def test_tikhonov_agrees_with_the_textbook(rows: int, cols: int, seed: int, log_mu: float) -> None:
    psf, y = scene(rows, cols, seed)
    mu = 10.0**log_mu
    fast = solved(psf, y, TIKHONOV, mu)
    slow = textbook.tikhonov(y.astype(float), textbook.otf(psf.astype(float), y.shape), mu)
    # One unit roundoff times the largest gain, times the root of the log of the size (rounding of an FFT); 1.4 was the
    # largest factor measured at round sizes (NUMERICS.md 3.5, item 10); prime sizes take more steps: the bound is four.
    bound = 4 * 2**-24 * np.sqrt(np.log2(y.size)) * (np.linalg.norm(y) / (2 * np.sqrt(mu)) + np.linalg.norm(slow))
    assert np.linalg.norm(fast - slow) <= bound


@given(SIZES, SIZES, SEEDS)
@settings(max_examples=25, deadline=None)
def test_gradient_agrees_with_the_textbook(rows: int, cols: int, seed: int) -> None:
    psf, y = scene(rows, cols, seed)
    H = textbook.otf(psf.astype(float), y.shape)
    cal = scenes.calibration(psf)
    model = periodic_model(cal, y.shape, 1, scenes.PLANNER, 0)
    gradient_power = textbook.gradient_power(y.shape)
    reg = 1e-2 * (gradient_power + GRADIENT.floor) + ClosedForm(model, GRADIENT, 1e-2).psf_error_term / (
        gradient_power + 1e-6
    )
    slow = textbook.flat_subtracted(y.astype(float), H, np.ones(y.shape), reg, fit_background=False)
    assert solved(psf, y, GRADIENT, 1e-2) == pytest.approx(slow, abs=2e-4 * float(y.max()))


@given(SIZES, SIZES, SEEDS)
@settings(max_examples=25, deadline=None)
def test_blur_and_its_adjoint_pass_the_dot_test(rows: int, cols: int, seed: int) -> None:
    psf, u = scene(rows, cols, seed)
    v = np.random.default_rng(seed + 1).standard_normal((rows, cols)).astype(np.float32)
    model = periodic_model(scenes.calibration(psf), (rows, cols), 1, scenes.PLANNER, 0)
    left = float((model.blur(u).astype(float) * v).sum())
    right = float((u.astype(float) * model.blur_adjoint(v)).sum())
    assert left == pytest.approx(right, rel=1e-4, abs=1e-5 * float(np.linalg.norm(u) * np.linalg.norm(v)))


@given(SEEDS, st.floats(0.01, 60))
@settings(max_examples=20, deadline=None)
def test_the_picture_is_proportional_to_the_light(seed: int, factor: float) -> None:
    psf, y = scene(24, 31, seed)
    once = solved(psf, y, GRADIENT, 1e-3)
    more = solved(psf, (y * np.float32(factor)).astype(np.float32), GRADIENT, 1e-3)
    assert more == pytest.approx(once * factor, rel=1e-3, abs=1e-3 * factor * float(np.abs(once).max()))


@given(SEEDS, st.integers(-20, 20), st.integers(-20, 20))
@settings(max_examples=20, deadline=None)
def test_a_shifted_psf_only_shifts_the_picture(seed: int, down: int, right: int) -> None:
    psf, y = scene(32, 40, seed)
    straight = solved(psf, y, TIKHONOV, 1e-2)
    shifted = solved(np.roll(psf, (down, right), (0, 1)), y, TIKHONOV, 1e-2)
    assert np.roll(shifted, (down, right), (0, 1)) == pytest.approx(straight, abs=1e-3 * float(np.abs(straight).max()))


@pytest.mark.parametrize("log_mu", range(-8, 2))
def test_the_norm_of_a_picture_is_limited_by_the_largest_gain(log_mu: int) -> None:
    psf, y = scene(48, 31, 5)
    mu = 10.0**log_mu
    assert np.linalg.norm(solved(psf, y, TIKHONOV, mu)) <= np.linalg.norm(y) / (2 * np.sqrt(mu)) * 1.001


def test_the_noise_of_a_picture_is_that_of_the_filter() -> None:
    psf, mu, sigma = scenes.speckle((96, 128)), 1e-3, 7.0
    noise = np.random.default_rng(3).normal(0, sigma, psf.shape).astype(np.float32)
    H = textbook.otf(psf.astype(float), psf.shape)
    gain = np.sqrt(np.mean((np.abs(H) / (np.abs(H) ** 2 + mu)) ** 2))
    assert solved(psf, noise, TIKHONOV, mu).std() == pytest.approx(sigma * gain, rel=0.05)  # 12288 pixels, few modes


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_a_binned_otf_is_that_of_a_block_mean_without_a_shift(n: int) -> None:
    grid = Grid.periodic((60, 60), n, float("inf"))
    H = otf(Psf(scenes.delta((60, 60))), grid)
    f = np.fft.rfftfreq(60 // n)
    mean = np.sin(np.pi * f[1:]) / (n * np.sin(np.pi * f[1:] / n))  # Dirichlet: the transfer of a mean over n pixels
    assert H[0, 1:].real == pytest.approx(mean, abs=1e-6)
    assert H.imag == pytest.approx(0, abs=1e-6)


@given(st.integers(1, 40), st.integers(1, 40), SIZES, SIZES)
@settings(max_examples=40, deadline=None)
def test_psfs_of_any_size_fit_on_any_torus(rows: int, cols: int, grid_rows: int, grid_cols: int) -> None:
    psf = np.zeros((rows, cols), np.float32)
    psf[rows // 2, cols // 2] = 1
    torus = wrapped(Psf(psf), (grid_rows, grid_cols))
    assert torus[0, 0] == pytest.approx(1)
    assert torus.sum() == pytest.approx(1)
