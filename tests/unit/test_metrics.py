"""Full-reference metrics: known answers, invariances, and comparison with scikit-image."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from device.errors import FrameError
from device.recon.assessment.metrics import (
    PictureScorer,
    fit_intensity,
    highpass,
    pcc,
    psnr_db,
    shift_px,
    ssim,
    vessel_contrast,
)
from device.recon.model.grid import disc

SHAPE = (72, 90)
INSIDE = disc(SHAPE, (35.5, 44.5), 30) > 0.5


def smooth(seed: int, grain_px: float = 2.0) -> np.ndarray:
    """Return a picture of blobs, 0 to 1."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).standard_normal(SHAPE))
    f2 = np.fft.fftfreq(SHAPE[0])[:, None] ** 2 + np.fft.rfftfreq(SHAPE[1])[None] ** 2
    image = np.fft.irfft2(spectrum * np.exp(-2 * (np.pi * grain_px) ** 2 * f2), SHAPE)
    return (image - image.min()) / np.ptp(image)


TRUTH = smooth(0)


def noisy(sigma: float, seed: int = 1) -> np.ndarray:
    return TRUTH + sigma * np.random.default_rng(seed).standard_normal(SHAPE)


@given(
    gain=st.floats(1e-3, 1e3), offset=st.floats(-1e3, 1e3), seed=st.integers(0, 20), sigma=st.sampled_from((0.01, 0.3))
)
def test_scores_are_independent_of_gain_and_offset(gain, offset, seed, sigma):
    scorer = PictureScorer(TRUTH.astype(np.float32), INSIDE, 12.0)
    plain, moved = scorer(noisy(sigma, seed)), scorer(gain * noisy(sigma, seed) + offset)
    for name in ("pcc", "psnr_db", "ssim", "highpass_pcc"):
        # 1e-6 of the offset is lost to rounding where the picture is a thousandth of it: 1e-4 of the score
        assert getattr(moved, name) == pytest.approx(getattr(plain, name), rel=1e-4, abs=1e-5), name


@given(scale=st.floats(-5, 5).filter(lambda s: abs(s) > 0.01), offset=st.floats(-5, 5))
def test_correlation_keeps_its_size_and_takes_the_sign_of_the_gain(scale, offset):
    expected = np.sign(scale) * pcc(noisy(0.1), TRUTH, INSIDE)
    assert pcc(scale * noisy(0.1) + offset, TRUTH, INSIDE) == pytest.approx(expected, abs=1e-9)


@given(error=st.floats(1e-4, 0.5))
def test_psnr_of_a_known_error_follows_the_definition(error):
    signs = np.where(np.indices(SHAPE).sum(axis=0) % 2, error, -error)
    assert psnr_db(TRUTH + signs, TRUTH, INSIDE) == pytest.approx(-20 * np.log10(error), abs=1e-9)


def test_psnr_after_the_fit_is_a_function_of_pcc():
    scorer = PictureScorer(TRUTH.astype(np.float32), INSIDE, 12.0)
    scores = scorer(noisy(0.2))
    assert scores.psnr_db == pytest.approx(-10 * np.log10(scorer.truth_variance * (1 - scores.pcc**2)), abs=1e-6)


def test_the_fit_is_the_least_squares_one():
    x = noisy(0.2)
    rows = np.stack([x[INSIDE], np.ones(INSIDE.sum())], axis=1)
    gain, offset = np.linalg.lstsq(rows, TRUTH[INSIDE], rcond=None)[0]
    np.testing.assert_allclose(fit_intensity(x, TRUTH, INSIDE), gain * x + offset, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.0, 0.02, 0.1, 0.5])
def test_ssim_agrees_with_scikit_image(sigma):
    x = noisy(sigma)
    core = np.zeros(SHAPE, np.bool_)
    core[6:-6, 6:-6] = True
    _, ssim_map = structural_similarity(
        x, TRUTH, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )
    assert ssim(x, TRUTH, core) == pytest.approx(ssim_map[core].mean(), abs=1e-3)
    assert ssim(x, TRUTH, core) == pytest.approx(1.0) if sigma == 0 else ssim(x, TRUTH, core) < 1


def test_pixels_outside_the_region_have_no_effect():
    vessels = smooth(3) > 0.6
    scorer = PictureScorer(TRUTH.astype(np.float32), INSIDE, 6.0, vessels)
    with_other_surroundings = np.where(INSIDE, noisy(0.1), 1e3 * smooth(5))
    with_other_surroundings[0, 0] = np.nan
    assert scorer(noisy(0.1)) == scorer(with_other_surroundings)


def test_a_smooth_shadow_costs_correlation_but_not_detail():
    scorer = PictureScorer(TRUTH.astype(np.float32), INSIDE, 6.0)
    shadow = np.linspace(-1, 1, SHAPE[1])[None] * np.ones(SHAPE)
    scores = scorer(TRUTH + shadow)
    assert scores.pcc < 0.5
    assert scores.highpass_pcc > 0.9  # at the edge the blur is one-sided, and a part of the ramp remains


def test_highpass_removes_a_constant_up_to_the_edge():
    assert np.abs(highpass(np.full(SHAPE, 7.0), INSIDE, 8.0)).max() < 1e-9


def test_vessel_contrast_of_drawn_vessels():
    vessels = np.zeros(SHAPE, np.bool_)
    vessels[34:37] = True
    assert vessel_contrast(np.where(vessels, 0.7, 1.0), vessels, INSIDE, 12.0) != 0
    assert vessel_contrast(np.where(vessels, 0.7, 1.0), vessels & INSIDE, INSIDE, 12.0) == pytest.approx(0.3, abs=1e-9)


def test_a_constant_picture_has_pcc_zero_and_finite_scores():
    scores = PictureScorer(TRUTH.astype(np.float32), INSIDE, 12.0)(np.full(SHAPE, 3.0))
    assert (scores.pcc, scores.vessel_contrast) == (0.0, None)
    assert np.isfinite([scores.psnr_db, scores.ssim, scores.highpass_pcc]).all()


@pytest.mark.parametrize("truth", [np.zeros(SHAPE), np.full(SHAPE, np.nan), np.ones((4, 4))])
def test_a_truth_without_contrast_or_of_another_shape_is_refused(truth):
    with pytest.raises(FrameError):
        PictureScorer(truth.astype(np.float32), INSIDE, 12.0)


@given(down=st.integers(-9, 9), across=st.integers(-9, 9))
def test_the_shift_of_a_picture_is_found(down, across):
    assert shift_px(5 * np.roll(noisy(0.1), (down, across), axis=(0, 1)) + 2, TRUTH) == (down, across)
