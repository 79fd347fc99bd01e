"""Resampling of binned pictures to the sensor: no shift, no ringing below zero, independent channels."""

import numpy as np
import pytest

from device.recon.model.grid import Grid
from device.recon.model.resampling import cubic_weights, to_sensor


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_a_ramp_is_reproduced(n: int) -> None:
    rows, cols = 12 * n + n - 1, 10 * n
    fine = np.arange(rows)[:, None] * 2.0 + np.arange(cols)[None] * 3.0
    complete_blocks = fine[: rows // n * n, : cols // n * n]
    binned = complete_blocks.reshape(rows // n, n, cols // n, n).mean(axis=(1, 3)).astype(np.float32)
    back = to_sensor(binned, Grid.periodic((rows, cols), n, float("inf")))
    inner = (slice(2 * n, rows - 3 * n), slice(2 * n, cols - 2 * n))
    assert back[inner] == pytest.approx(fine[inner], abs=1e-3)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8])
def test_weights_sum_to_one(n: int) -> None:
    _, weights = cubic_weights(n)
    assert weights.sum(axis=1) == pytest.approx(1, abs=1e-6)


def test_channels_are_independent() -> None:
    picture = np.zeros((6, 6, 3), np.float32)
    picture[..., 1] = 5
    back = to_sensor(picture, Grid.periodic((12, 12), 2, float("inf")))
    assert back[..., 1] == pytest.approx(5)
    assert not back[..., 0].any()


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_tight_grid_maps_every_pixel_without_a_shift(n: int) -> None:
    sensor, radius = (61 * n, 80 * n + 1), 15.0 * n
    grid = Grid.tight(sensor, n, radius, psf_radius_px=12 * n)
    rows, cols = (
        np.arange(size)[:, None] if axis == 0 else np.arange(size)[None] for axis, size in enumerate(grid.shape)
    )
    ramp = (rows - grid.centre[0]) * 2 + (cols - grid.centre[1]) * 3
    back = to_sensor(ramp.astype(np.float32), grid)
    i, j = np.indices(sensor)
    truth = ((i - (sensor[0] - 1) / 2) * 2 + (j - (sensor[1] - 1) / 2) * 3) / n
    inside = np.hypot(i - (sensor[0] - 1) / 2, j - (sensor[1] - 1) / 2) < radius - 2
    assert back[inside] == pytest.approx(truth[inside], abs=1e-3)


def test_a_nonnegative_picture_remains_nonnegative() -> None:
    picture = np.zeros((12, 12), np.float32)
    picture[4:8, 4:8] = 100
    assert to_sensor(picture, Grid.periodic((36, 36), 3, float("inf"))).min() == 0
