"""Durations of the steps of a reconstruction: from them a deadline decides what still fits (NUMERICS.md 5)."""

from collections import deque
from math import ceil
from statistics import median, median_low

WINDOW = 200  # durations: the next one is longer than the second largest in one of a hundred runs
QUANTILE = 0.99
STALL = 8.0  # times the median: the machine was busy during one step; a steady load makes at most 5
TRIED_AFTER = 200  # skips of a step that usually fits: a trial may be late, as one in a hundred runs may
LEAST_RUNS = 3  # fewest whose median shows no stall
PACE_WINDOW = 11
LEAST_S = 1e-6
CYLINDER_SEARCHES = 6  # most of the duration of a cylinder in searches for M on noise, which end after the coarse one


class Pace:
    """Duration of the step that every picture begins with, now: median of its last 11."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=PACE_WINDOW)

    def add(self, seconds: float) -> None:
        """Add the duration of one run."""
        self._seen.append(seconds)

    @property
    def seconds(self) -> float:
        """Median of the stored durations in seconds, at least 1e-6."""
        return max(median(self._seen), LEAST_S) if self._seen else LEAST_S


class DurationEstimate:
    """Estimate of the duration of a step in seconds, from its last 200 runs.

    Durations are kept as multiples of the pace at their time: a machine that becomes slower or faster shows in the
    first step of the next pictures, also where another step is skipped.

    Parameters
    ----------
    pace
        Pace of the machine.
    """

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._seen: deque[float] = deque(maxlen=WINDOW)
        self._skips = 0  # since the last run

    def add(self, seconds: float) -> None:
        """Add the duration of one run."""
        self._seen.append(seconds / self._pace.seconds)
        self._skips = 0

    @property
    def seconds(self) -> float:
        """Quantile of 99 %: the second largest of 200 durations, the largest of fewer; 0.0 before the first run.

        The median after 200 skips, until the next run.
        """
        if not self._seen:
            return 0.0
        rank = min(ceil(QUANTILE * (len(self._seen) + 1)), len(self._seen))
        if self._skips >= TRIED_AFTER:
            return self.typical_s
        return self._pace.seconds * sorted(self._seen)[rank - 1]

    @property
    def typical_s(self) -> float:
        """Median of the stored durations; 0.0 before the first run."""
        return self._pace.seconds * median(self._seen) if self._seen else 0.0

    def seconds_of(self, count: int) -> float:
        """Return the estimated duration of `count` runs in seconds: one that is slow, and the median of the others."""
        return self.seconds + (count - 1) * self.typical_s if count else 0.0

    def skipped(self, usually_fits: bool) -> None:
        """Reduce the estimate after the step was skipped for want of time: it records no duration.

        One or two durations are halved. Of more, a skip forgets one stall; after 200 skips of a step that usually fits
        the median is the estimate, so that it is tried once. Where it usually does not fit, the time is too short.

        Parameters
        ----------
        usually_fits
            True if a run of median duration would have fitted.
        """
        if len(self._seen) < LEAST_RUNS:
            self._seen = deque((ratio / 2 for ratio in self._seen), WINDOW)
        elif (largest := max(self._seen)) > STALL * median_low(self._seen):
            self._seen.remove(largest)
        elif usually_fits:
            self._skips += 1


class RefractionCosts:
    """Durations of the search for the mean sphere, of the cylinder with the joining of frames, and of the eye's PSF.

    Parameters
    ----------
    pace
        Pace of the machine.
    """

    def __init__(self, pace: Pace) -> None:
        self.find = DurationEstimate(pace)
        self.cylinder = DurationEstimate(pace)
        self.refocus = DurationEstimate(pace)

    @property
    def cylinder_s(self) -> float:
        """Typical duration of the search for a cylinder and of the joining with other frames in seconds."""
        return max(self.cylinder.typical_s, CYLINDER_SEARCHES * self.find.typical_s)
