"""Simulated sensor against the statistics of shot noise, read noise and converter."""

import numpy as np
import pytest

from device.sim.sensor import SensorModel

MODEL = SensorModel(gain_e_per_dn=2.0, black_dn=64, white_dn=4095, full_well_e=8000.0, read_noise_e=3.0)


def flat(electrons, shape=(300, 400)):
    return np.full(shape, electrons, np.float32)


@pytest.mark.parametrize("mean_e", [0.0, 0.3, 5.0, 60.0, 99.0, 101.0, 1000.0, 6000.0])
def test_mean_and_variance_follow_the_photon_law_on_both_sides_of_the_gaussian_bound(mean_e):
    electrons = (MODEL.read(flat(mean_e), 1).astype(np.float64) - MODEL.black_dn) * MODEL.gain_e_per_dn
    variance = mean_e + MODEL.read_noise_e**2 + MODEL.gain_e_per_dn**2 / 12
    pixels = electrons.size
    assert electrons.mean() == pytest.approx(mean_e, abs=5 * np.sqrt(variance / pixels))
    assert electrons.var() == pytest.approx(variance, rel=0.03)


def test_low_counts_have_the_skewness_of_poisson():
    quiet = SensorModel(0.1, 1000, 65535, 6000.0, 0.0)
    electrons = (quiet.read(flat(4.0), 2).astype(np.float64) - 1000) * 0.1
    assert ((electrons - 4) ** 3).mean() == pytest.approx(4, rel=0.1)
    assert np.allclose(electrons, np.rint(electrons))


def test_nothing_exceeds_the_well_or_the_converter():
    assert MODEL.read(flat(1e6), 1).min() == 64 + 4000
    assert SensorModel(1.0, 64, 4095, 1e6, 1.0).read(flat(1e5), 1).min() == 4095


def test_counts_never_wrap_below_zero():
    noisy = SensorModel(1.0, 0.0, 4095, 5000.0, 20.0).read(flat(0.0), 1)
    assert noisy.min() == 0
    assert noisy.max() < 200


def test_noise_is_reproducible_by_seed():
    assert np.array_equal(MODEL.read(flat(50), (4, 1)), MODEL.read(flat(50), (4, 1)))
    assert not np.array_equal(MODEL.read(flat(50), (4, 1)), MODEL.read(flat(50), (4, 2)))


def test_strips_have_independent_noise():
    counts = MODEL.read(flat(500, (256, 200)), 1).astype(np.float64)
    assert abs(np.corrcoef(counts[:64].ravel(), counts[64:128].ravel())[0, 1]) < 0.05


def test_the_callers_buffer_is_filled_even_a_strided_one():
    large = np.zeros((300, 800), np.uint16)
    got = MODEL.read(flat(100), 1, large[:, ::2])
    assert np.shares_memory(got, large)
    assert large[:, ::2].min() > 64
    assert not large[:, 1::2].any()
