"""Spots in a residual: connected samples beyond its noise, dark or bright."""

from math import inf

import numpy as np
import pytest

from device.recon.estimation.spots import BORDER_SAMPLES, find_spots, on_sensor
from device.recon.model.grid import Grid
from device.values import Image

SHAPE = (120, 160)


def noise(seed: int) -> Image:
    return np.random.default_rng(seed).normal(size=SHAPE).astype(np.float32)


@pytest.mark.parametrize("seed", range(20))
def test_noise_has_no_spots(seed: int) -> None:
    assert find_spots(noise(seed), np.ones(SHAPE, np.bool_)) is None


@pytest.mark.parametrize("height_sd", [-8.0, 8.0])
def test_a_spot_is_found_with_its_sign_its_place_and_a_border(height_sd: float) -> None:
    left = noise(1)
    left[40:50, 60:72] += height_sd
    spots = find_spots(left, np.ones(SHAPE, np.bool_))
    assert spots is not None
    assert spots.are_dark == (height_sd < 0)
    assert spots.largest == pytest.approx((44.5, 65.5), abs=1)
    assert spots.samples[41 - BORDER_SAMPLES : 49 + BORDER_SAMPLES, 61:71].all()
    assert not spots.samples[:30].any()


def test_single_samples_and_missing_ones_are_no_spots() -> None:
    left, good = noise(1), np.ones(SHAPE, np.bool_)
    left[10, 10] = 30.0
    left[40:50, 60:72], good[40:50, 60:72] = 100.0, False
    assert find_spots(left, good) is None
    assert find_spots(left, np.zeros(SHAPE, np.bool_)) is None


def test_samples_are_blocks_of_pixels_of_the_sensor() -> None:
    grid = Grid.periodic((64, 96), 2, inf)
    samples = np.zeros(grid.window, np.bool_)
    samples[3, 5] = True
    pixels = on_sensor(samples, grid)
    assert pixels.shape == grid.sensor
    top, left = grid.first_px
    at = [[top + 6, left + 10], [top + 6, left + 11], [top + 7, left + 10], [top + 7, left + 11]]
    assert np.argwhere(pixels).tolist() == at
