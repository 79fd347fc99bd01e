"""Binned pictures come back where they belong."""

import numpy as np
import pytest

from device.recon.upsample import cubic_weights, upsample


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_a_ramp_stays_the_ramp_that_it_was(n: int) -> None:
    rows, cols = 12 * n + n - 1, 10 * n
    fine = np.arange(rows)[:, None] * 2.0 + np.arange(cols)[None] * 3.0
    whole = fine[: rows // n * n, : cols // n * n]
    binned = whole.reshape(rows // n, n, cols // n, n).mean(axis=(1, 3)).astype(np.float32)
    back = upsample(binned, n, (rows, cols))
    inner = (slice(2 * n, rows - 3 * n), slice(2 * n, cols - 2 * n))
    assert back[inner] == pytest.approx(fine[inner], abs=1e-3)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8])
def test_weights_are_an_interpolation(n: int) -> None:
    _, weights = cubic_weights(n)
    assert weights.sum(axis=1) == pytest.approx(1, abs=1e-6)


def test_colour_is_kept_apart() -> None:
    picture = np.zeros((6, 6, 3), np.float32)
    picture[..., 1] = 5
    back = upsample(picture, 2, (12, 12))
    assert back[..., 1] == pytest.approx(5)
    assert not back[..., 0].any()
