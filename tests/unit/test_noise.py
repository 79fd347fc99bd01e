"""Noise model of a sample: the light from which on its noise dithers the rounding of the counts."""

import numpy as np
import pytest

from device.recon.estimation.noise import Noise
from device.values import Sensor

GAINS = pytest.mark.parametrize(("gain_e_per_dn", "read_noise_e"), [(10.4, 2.2), (5.7, 1.0)])
PHASES = np.linspace(0, 1, 20, endpoint=False)


def noise_of(gain_e_per_dn: float, read_noise_e: float, n: int) -> Noise:
    """Return the noise of samples of n x n pixels of a sensor."""
    return Noise.of(Sensor(60.0, gain_e_per_dn, read_noise_e, 1023.0), n, 1.0, 100.0)


def shift_by_rounding(sd_dn: float) -> float:
    """Return the largest difference of the mean of rounded counts from their light, over all phases, in DN."""
    drawn = np.random.default_rng(1).normal(0, sd_dn, 200_000)
    return max(abs(float(np.mean(np.rint(drawn + phase) - drawn) - phase)) for phase in PHASES)


@GAINS
def test_light_that_dithers_leaves_the_mean_of_the_counts(gain_e_per_dn: float, read_noise_e: float) -> None:
    """Rounding shifts the mean by at most 0.0023 + 0.0045 (four standard errors) DN there, by ten times that at 0."""
    light_dn = noise_of(gain_e_per_dn, read_noise_e, 5).dithered_dn(5)
    variance_dn2 = light_dn / gain_e_per_dn + (read_noise_e / gain_e_per_dn) ** 2
    assert shift_by_rounding(variance_dn2**0.5) < 0.0068
    assert shift_by_rounding(read_noise_e / gain_e_per_dn) > 0.1


@GAINS
def test_light_that_dithers_does_not_depend_on_the_samples(gain_e_per_dn: float, read_noise_e: float) -> None:
    """It is a property of the pixels."""
    lights = [noise_of(gain_e_per_dn, read_noise_e, n).dithered_dn(n) for n in (1, 4, 7)]
    np.testing.assert_allclose(lights, lights[0], rtol=1e-9)


def test_read_noise_above_the_limit_dithers_darkness() -> None:
    """With a read noise of one count every light is dithered."""
    assert noise_of(2.0, 2.0, 5).dithered_dn(5) == 0
