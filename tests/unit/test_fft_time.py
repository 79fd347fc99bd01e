"""Time in FFT pairs, and the time of a Raspberry Pi 5 by a stated factor."""

import pytest

from device.clock import SystemClock
from device.recon.model.fft_plans import Planner
from services.research.fft_time import PI5_FACTOR, REFERENCE_PAIR_S, REFERENCE_SHAPE, pair_s, pi5_s
from services.research.pair_scores import PairScore, rows, table


def test_a_pair_of_the_reference_takes_the_factor_times_its_time() -> None:
    assert pi5_s(2.0, REFERENCE_SHAPE) == pytest.approx(2 * PI5_FACTOR * REFERENCE_PAIR_S)
    rows_px, cols_px = REFERENCE_SHAPE
    assert pi5_s(1.0, (rows_px // 2, cols_px // 2)) < pi5_s(1.0, REFERENCE_SHAPE) / 4


def test_a_pair_is_timed() -> None:
    assert 0 < pair_s(Planner(None, effort="FFTW_ESTIMATE"), (64, 96), SystemClock()) < 1


def test_the_table_holds_both_times_and_marks_the_one_that_is_not_measured() -> None:
    score = PairScore("pair", "gradient", 2, 1, 0.1, 4.0, 0.24, None, None, None)
    (row,) = rows([score])
    assert (row.fft_pairs_median, row.pi5_seconds_median) == (4.0, 0.24)
    head, line, mark = table([row]).splitlines()
    assert "FFT pairs  Pi 5 s*" in head
    assert "4.0     0.24" in line
    assert "not measured" in mark
