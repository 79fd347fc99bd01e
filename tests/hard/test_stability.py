"""Stability of the default schedule: the gain |change of the picture| / |change of the frame|.

Proven: the gain of the closed form is at most 1 / (2 sqrt mu) (NUMERICS.md 3.5, item 1), for every frame and every
change. The search of this module finds that gain to a tenth. Measured only: the parameters of the default schedule
(noise, prior, shading, refraction) depend on the frame, and twelve ADMM rounds of a total variation have no known
constant in this norm (each of their proximal steps is nonexpansive in the norm of the splitting; the inverse of the
data step is not). The limits are therefore three times the measured gains (22 to 35, 45, 15, and .0024), and an
untested change may have a larger one. All norms are over the sensor's pixels, in DN.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from device.clock import VirtualClock
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.values import Image
from tests import scenes
from tests.hard.defects import blob
from tests.hard.frames import Eye

EYE = Eye("relaxed eye, merged", "sim", {"sim.seed": 1}, merged=4)
RANDOM, ADVERSE, PIXEL, RING = 105.0, 135.0, 45.0, 0.0075
Within = Callable[[float, float], None]
Solve = Callable[[Image], Image]


@pytest.fixture(scope="module")
def frame() -> Image:
    return EYE.clean.raw.astype(np.float32)


def default_solve(**options: bool) -> Solve:
    of = EYE.clean.simulated
    reconstructor = Reconstructor(of.calibration, of.shape, scenes.PLANNER, VirtualClock(), **options)
    return lambda y: reconstructor(y).picture.astype(np.float64)


@pytest.fixture(scope="module")
def solve() -> Solve:
    return default_solve()


@pytest.fixture(scope="module")
def picture(solve: Solve, frame: Image) -> Image:
    return solve(frame)


@pytest.fixture(scope="module")
def noise_dn(frame: Image) -> Image:
    """Return the standard deviation of the shot noise of each pixel."""
    camera = EYE.spec.camera
    return np.sqrt(np.maximum(frame - camera.black_dn, 1) / camera.gain_e_per_dn)


def gain(solve: Solve, y: Image, picture: Image, change: Image) -> float:
    return float(np.linalg.norm(solve((y + change).astype(np.float32)) - picture) / np.linalg.norm(change))


def worst_direction(solve: Solve, y: Image, size: float, rounds: int = 6) -> Image:
    """Return the change of norm `size` with the largest gain, by power iteration with finite differences.

    J is nearly a convolution, so its adjoint is J between two flips.
    """
    here = solve(y)

    def change_of_picture(direction: Image) -> Image:
        return solve((y + size / np.linalg.norm(direction) * direction).astype(np.float32)) - here

    direction = np.random.default_rng(5).standard_normal(y.shape)
    for _ in range(rounds):
        direction = change_of_picture(change_of_picture(direction)[::-1, ::-1])[::-1, ::-1]
    return (size / np.linalg.norm(direction) * direction).astype(np.float32)


def test_the_same_frame_gives_the_same_picture(solve: Solve, frame: Image, picture: Image) -> None:
    assert np.array_equal(solve(frame), picture)


@pytest.mark.parametrize("share", [0.03, 0.3, 1.0])
def test_random_changes_of_the_size_of_the_noise(
    share: float, solve: Solve, frame: Image, picture: Image, noise_dn: Image, within: Within
) -> None:
    rng = np.random.default_rng(7)
    changes = (share * noise_dn * rng.standard_normal(frame.shape) for _ in range(4))
    within(max(gain(solve, frame, picture, change) for change in changes), RANDOM)


@pytest.mark.parametrize("share", [0.03, 0.3])
def test_the_worst_change_that_a_power_iteration_finds(
    share: float, solve: Solve, frame: Image, picture: Image, noise_dn: Image, within: Within
) -> None:
    """The search leaves the refraction as it is, which takes most of the time; the gain is that of the whole."""
    size = share * float(np.linalg.norm(noise_dn))
    change = worst_direction(default_solve(refract=False), frame, size)
    within(gain(solve, frame, picture, change), ADVERSE)


@pytest.mark.parametrize("more_dn", [1.0, 30.0])
def test_one_pixel(more_dn: float, solve: Solve, frame: Image, picture: Image, within: Within) -> None:
    change = np.zeros_like(frame)
    change[frame.shape[0] // 2, frame.shape[1] // 2] = more_dn
    within(gain(solve, frame, picture, change), PIXEL)


@pytest.mark.parametrize("radius_px", [0, 1, 4, 9, 15])
def test_a_gap_that_grows_by_one_pixel(radius_px: int, solve: Solve, frame: Image, within: Within) -> None:
    """The change of the picture as a share of it is small for every radius."""

    def with_gap(radius: float) -> Image:
        y = frame.copy()
        y[blob(EYE.clean.simulated.shape, radius / frame.shape[0])] = np.nan
        return y

    before, after = solve(with_gap(radius_px)), solve(with_gap(radius_px + 1))
    within(float(np.linalg.norm(after - before) / np.linalg.norm(before)), RING)


@pytest.mark.parametrize("share", [0.03, 1.0])
def test_tikhonov_keeps_its_bound_in_its_worst_direction(
    share: float, frame: Image, noise_dn: Image, within: Within
) -> None:
    """Periodic and without a taper, as in the theorem; mu is fixed, because cross-validation depends on the frame."""
    from device.recon.solvers.wiener import TIKHONOV, ClosedForm

    mu = 1e-4
    calibration = replace(EYE.clean.simulated.calibration, field_deg=None)
    make = Reconstructor(
        calibration, EYE.clean.simulated.shape, scenes.PLANNER, VirtualClock(), (Recipe("tikhonov", 1),), refract=False
    )
    make.stages[0].model.fade = None
    make.stages[0].solver = ClosedForm(make.stages[0].model, TIKHONOV, mu)

    def solved(y: Image) -> Image:
        return make(y).picture.astype(np.float64)

    size = share * float(np.linalg.norm(noise_dn))
    seen = gain(solved, frame, solved(frame), worst_direction(solved, frame, size)) * 2 * np.sqrt(mu)
    within(seen, 1 + 1e-3)
    assert seen > 0.9  # the search finds the known worst direction
