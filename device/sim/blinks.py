"""Blinks of a simulated eye: the share of an exposure during which the lid is closed; OPTICS.md 3.9."""

from math import floor

import numpy as np

from device.sim.optical_setup import Scene

BLINK_S = 0.25  # from the closing lid to the opening one
MIN_CHANCE = 0.01  # that a blink meets an exposure
WINDOW_S = 10.0  # each has random numbers of its own, so that a moment's blinks do not depend on those before


def lid_share(scene: Scene, begin_s: float, exposure_s: float) -> float:
    """Return the share of an exposure during which the lid is closed, 0 to 1; `begin_s` is any clock's time, 0 or more.

    Blinks are a Poisson process of `blinks_per_min`, drawn from the scene's seed, if the chance that one meets an
    exposure is at least MIN_CHANCE; else there are none. The time in which two blinks overlap counts once.
    """
    per_s = scene.sim.eye.blinks_per_min / 60
    end_s = begin_s + exposure_s
    if per_s * (exposure_s + BLINK_S) < MIN_CHANCE:
        return 0.0
    starts_s = np.concatenate(
        [
            _starts_s(scene.seed, window, per_s)
            for window in range(max(floor((begin_s - BLINK_S) / WINDOW_S), 0), floor(end_s / WINDOW_S) + 1)
        ]
    )
    over_s = np.minimum(starts_s + BLINK_S, np.append(starts_s[1:], np.inf))
    closed_s = np.clip(np.minimum(over_s, end_s) - np.maximum(starts_s, begin_s), 0, None)
    return float(min(closed_s.sum() / exposure_s, 1.0))


def _starts_s(seed: int, window: int, per_s: float) -> np.ndarray:
    """Return the begins of the blinks of one window, ascending, seconds."""
    random = np.random.default_rng((seed, 9, window))
    return np.sort(WINDOW_S * (window + random.random(random.poisson(per_s * WINDOW_S))))
