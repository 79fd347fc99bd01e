"""Ghost: displacement and share from its trace, and the frame without it."""

import numpy as np
import pytest

from device.recon.estimation.ghost import STRENGTH, Ghost, GhostTrace, share_of
from device.recon.model.grid import Grid

SHAPE = 64, 96
GRID = Grid.periodic(SHAPE, 1, 20.0)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_the_share_follows_from_the_strength(share: float) -> None:
    assert share_of(share / (1 + share) ** 2 / STRENGTH) == pytest.approx(share)


@pytest.mark.parametrize("shift", [(5.25, -7.5), (-12.0, 3.25)])
def test_the_displacement_is_refined_between_samples(shift: tuple[float, float]) -> None:
    rows, cols = ((np.fft.fftfreq(size, 1 / size) - at) for size, at in zip(SHAPE, shift, strict=True))
    score = np.asarray(10 - rows[:, None] ** 2 - cols**2, np.float32)
    assert GhostTrace(score, score, 1).strongest() == pytest.approx(shift, abs=0.01)
    assert GhostTrace(score, score, 4).strongest() == pytest.approx((4 * shift[0], 4 * shift[1]), abs=0.04)


def test_the_frame_without_the_ghost_is_the_first_image() -> None:
    single = np.random.default_rng(1).uniform(10, 20, SHAPE).astype(np.float32)
    light = single + 0.3 * np.roll(single, (6, -9), (0, 1))
    removed = Ghost((6.0, -9.0), np.asarray(light, np.float32)).removal(0.3, GRID)
    assert removed.share == 0.3
    np.testing.assert_allclose(light - removed.added_dn, 0.7 * single, atol=1e-3)
    assert "30%" in removed.words
    assert "-9 pixels to the right and +6 down" in removed.words
