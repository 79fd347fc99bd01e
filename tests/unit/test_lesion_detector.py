"""Detector of the lesions' bench: places and contrasts of drawn spots, and its false rate on noise."""

from math import exp, pi

import numpy as np
import pytest

from tests.bench.drawn_lesions import SPOTS, VESSELS, Kind, Lesion, scattered, with_lesions
from tests.bench.matched_filter import MatchedFilter, relative

UM_PER_PX = 15.0
SHAPE = (300, 320)


@pytest.mark.parametrize("kind", [*SPOTS, *VESSELS], ids=lambda kind: kind.name)
def test_a_drawn_lesion_is_found_at_its_place_with_its_contrast(kind: Kind) -> None:
    turn_rad = pi / 3 if kind.length_um else 0.0
    lesion = Lesion(kind, 140.3, 171.8, turn_rad)
    flat = np.full(SHAPE, 0.01, np.float32)
    detail = relative(with_lesions(flat, [lesion], UM_PER_PX), np.ones(SHAPE, bool), UM_PER_PX)
    found = MatchedFilter(kind, UM_PER_PX).candidates(detail)
    best = int(np.argmax(found.contrasts))
    np.testing.assert_allclose(found.places[best], (lesion.row, lesion.col), atol=1.0)
    assert found.best_near(lesion, UM_PER_PX) == pytest.approx(abs(kind.contrast), rel=0.12)


def test_a_lesion_of_the_other_sign_is_not_found_at_its_place() -> None:
    dark, bright = SPOTS[1], SPOTS[4]
    lesion = Lesion(bright, 150.0, 150.0)
    detail = relative(with_lesions(np.ones(SHAPE, np.float32), [lesion], UM_PER_PX), np.ones(SHAPE, bool), UM_PER_PX)
    assert MatchedFilter(dark, UM_PER_PX).candidates(detail).best_near(lesion, UM_PER_PX) < 0.06


def test_pure_noise_gives_the_false_rate_of_theory() -> None:
    """Maxima above u sd of a Gaussian field: area * slope^2 * u exp(-u^2 / 2) / (2 pi)^1.5 (Adler 1981)."""
    finder = MatchedFilter(SPOTS[2], UM_PER_PX)
    (kernel,) = finder.kernels
    energy = float(np.vdot(kernel, kernel))
    slope2 = sum(float(np.vdot(part, part)) for part in np.gradient(kernel)) / (2 * energy)
    noise = np.random.default_rng(1).standard_normal((1500, 1500), np.float32)
    heights = finder.candidates(noise).contrasts / energy**0.5
    for u in (3.0, 3.5):
        expected = noise.size * slope2 * u * exp(-(u**2) / 2) / (2 * pi) ** 1.5
        assert (heights > u).sum() == pytest.approx(expected, abs=3 * expected**0.5 + 0.1 * expected)


def test_lesions_are_apart_and_inside_of_the_mask() -> None:
    allowed = np.zeros((600, 600), bool)
    allowed[100:500, 100:500] = True
    lesions = scattered(SPOTS, allowed, UM_PER_PX, np.random.default_rng(0))
    assert len(lesions) == sum(kind.count for kind in SPOTS)
    places = np.array([(lesion.row, lesion.col) for lesion in lesions])
    apart = np.hypot(*(places[:, None] - places[None]).T) + 1e9 * np.eye(len(places))
    assert apart.min() * UM_PER_PX > 450
    assert allowed[tuple(np.round(places).astype(int).T)].all()
