"""CIEDE2000 of the benchmark of colours against published pairs."""

import numpy as np
import pytest

from tests.bench.colour_difference import ciede2000, lab

# G. Sharma, W. Wu, E. Dalal, Color Research and Application 30, 21, 2005, table 1: pairs 1, 7, 17 and 25.
PAIRS = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
]


@pytest.mark.parametrize(("left", "right", "difference"), PAIRS)
def test_published_pairs_are_met(
    left: tuple[float, float, float], right: tuple[float, float, float], difference: float
) -> None:
    first, second = np.array([left]), np.array([right])
    assert ciede2000(first, second)[0] == pytest.approx(difference, abs=1e-4)  # the table's digits
    assert ciede2000(second, first)[0] == pytest.approx(difference, abs=1e-4)


def test_white_has_no_chroma() -> None:
    assert lab(np.ones((1, 3)))[0] == pytest.approx([100, 0, 0], abs=1e-9)
