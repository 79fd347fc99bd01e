"""Flicker of a lamp as a periodic gain of the rows: found in their means, and taken out of the counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.recon.estimation.flicker import FlickerFinder, row_gain
from device.recon.model.kernels import Pixels

ROWS = 600
PLACE = np.linspace(-1, 1, ROWS)
STEADY_DN = 900 * np.exp(-(PLACE**2)) * (1 + 0.1 * PLACE)  # the light of a disc, brighter below
WHITE_DN = 4095.0


def triangle(cycles: float, phase: float) -> np.ndarray:
    periods = cycles * np.linspace(0, 1, ROWS) + phase
    return 1 - 4 * np.abs(periods % 1 - 0.5)


@given(share=st.floats(0.01, 0.3), cycles=st.floats(8, 80), phase=st.floats(0, 1))
def test_the_gain_of_bands_is_found(share: float, cycles: float, phase: float) -> None:
    gain = 1 + share * triangle(cycles, phase)
    found = row_gain(STEADY_DN * gain)
    assert found is not None
    ratio = found / gain
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.2 * share  # the peaks of a triangle have harmonics without end


@pytest.mark.parametrize("light", ["few rows", "dark", "steady", "noise"])
def test_rows_without_a_line_have_no_gain(light: str) -> None:
    rows = {
        "few rows": np.full(40, 100.0),
        "dark": np.zeros(ROWS),
        "steady": STEADY_DN,
        "noise": 100.0 + np.random.default_rng(1).normal(0, 1, ROWS),
    }
    assert row_gain(rows[light]) is None


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("own_dark", [False, True])
def test_counts_lose_the_flicker_and_keep_what_is_saturated(channels: tuple[int, ...], own_dark: bool) -> None:
    steady = np.broadcast_to(STEADY_DN.reshape(-1, *(1 for _ in (1, *channels))), (ROWS, 40, *channels))
    gain = (1 + 0.2 * triangle(20, 0.1)).reshape(-1, *(1 for _ in (1, *channels)))
    counts: Pixels = (64 + steady * gain).astype(np.float32)
    counts[5, 7] = WHITE_DN
    calibrated = np.full((1, 40), 0.0 if own_dark else 64.0, np.float32)
    dark = np.full(counts.shape, 64.0, np.float32) if own_dark else None
    found = FlickerFinder(calibrated, WHITE_DN)(counts, dark)
    assert found is not None
    assert found.flicker == pytest.approx(0.2 / 3**0.5, rel=0.05)
    assert np.all(found.counts[5, 7] == np.float32(WHITE_DN))
    light = found.counts - 64
    light[5, 7] = steady[5, 7]
    ratio = light / steady
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.02
