"""Estimates of durations: quantile, pace, stalls, and steps that are skipped."""

import numpy as np
import pytest

from device.recon.durations import TRIED_AFTER, DurationEstimate, Pace


def paced(seconds: float) -> Pace:
    pace = Pace()
    pace.add(seconds)
    return pace


def estimate(pace: Pace, durations_s: list[float]) -> DurationEstimate:
    of = DurationEstimate(pace)
    for duration_s in durations_s:
        of.add(duration_s)
    return of


def test_the_estimate_is_the_maximum_of_few_and_the_upper_quantile_of_many() -> None:
    assert estimate(paced(0.1), []).seconds == estimate(paced(0.1), []).typical_s == 0
    few = estimate(paced(0.1), [0.2, 0.5, 0.3])
    assert (few.seconds, few.typical_s) == (pytest.approx(0.5), pytest.approx(0.3))
    many = estimate(paced(0.1), [9.0] * 50 + [0.01 * k for k in range(1, 201)])
    assert many.seconds == pytest.approx(1.99), "the first ones are forgotten, one of two hundred may be longer"


def test_one_step_in_a_hundred_takes_longer_than_estimated() -> None:
    """By the maximum of twelve it would be one in thirteen."""
    random = np.random.default_rng(1)
    of, longer = DurationEstimate(paced(0.1)), 0
    for k, duration_s in enumerate(random.lognormal(-3, 0.5, 3000)):
        longer += k >= 200 and duration_s > of.seconds
        of.add(duration_s)
    assert longer / 2800 < 0.0125


def test_a_machine_that_changes_its_pace_changes_the_estimate_of_steps_that_are_skipped() -> None:
    pace = paced(0.1)
    of = estimate(pace, [0.4] * 20)
    for _ in range(11):
        pace.add(0.3)
    assert of.seconds == pytest.approx(1.2), "another program began"
    for _ in range(11):
        pace.add(0.1)
    assert of.seconds == pytest.approx(0.4), "and ended"


def test_a_stall_is_forgotten_when_the_step_is_skipped() -> None:
    of = estimate(paced(0.1), [0.4, 60.0, 0.4])
    of.skipped(usually_fits=True)
    assert of.seconds == pytest.approx(0.4)


def test_a_step_that_usually_fits_is_tried_seldom_but_again() -> None:
    of = estimate(paced(0.1), [0.4, 0.2] * 50)
    for _ in range(100):
        of.skipped(usually_fits=False)
    assert of.seconds == pytest.approx(0.4), "the time is too short"
    skips = 0
    while of.seconds > 0.31:
        of.skipped(usually_fits=True)
        skips += 1
    assert skips == TRIED_AFTER
    of.add(0.4)
    assert of.seconds == pytest.approx(0.4), "one trial shows that nothing has changed"


def test_one_or_two_durations_tell_no_stall_and_are_halved() -> None:
    few = estimate(paced(0.1), [60.0])
    for _ in range(10):
        few.skipped(usually_fits=False)
    assert few.seconds < 0.06


def test_estimates_without_a_clock_that_runs_are_zero() -> None:
    of = estimate(paced(0.0), [0.0, 60.0, 0.0])
    of.skipped(usually_fits=True)
    assert of.seconds == 0
