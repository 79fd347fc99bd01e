"""Progress estimate of each capture: stage, fraction done and seconds left."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

from device.clock import Clock

STAGES = {"expose": 0.1, "quick": 0.4, "keep": 0.9}  # fraction done at the begin of each stage
_NEXT_FRACTION = dict(
    zip(STAGES, [*list(STAGES.values())[1:], 1.0], strict=True)
)  # fraction done at the end of each stage
_ONGOING_STAGE = {"quick": "refine"}  # event name of a running stage, if it differs
STORAGE_S = 0.4
RECENT = 5  # number of captures whose durations enter the estimate


@dataclass(frozen=True)
class ProgressEstimate:
    """Progress of a capture: its stage as the page names it, fraction done (0 to 1), and seconds left until storage."""

    stage: str
    fraction: float
    left_s: float


class Progress:
    """Progress estimator: the time left at a stage is the median time from that stage to storage, last RECENT captures.

    Before the first capture, defaults replace the median: from `exposing_s`, the duration of the dark and the lit
    exposures of a press without other colours, the time budget `budget_s` (both in seconds) and STORAGE_S. The thread
    that owns the head calls the methods, `estimate` also that of the preparation, while the former exposes; `late_s`
    may be read from any thread.
    """

    def __init__(self, clock: Clock, exposing_s: float, budget_s: Callable[[], float]) -> None:
        self._clock, self._exposing_s, self._at_most_s = clock, exposing_s, budget_s
        self._took_s: dict[str, deque[float]] = {stage: deque(maxlen=RECENT) for stage in STAGES}
        self._reached_s: dict[str, dict[str, float]] = {}  # by capture and stage
        self._due_s: dict[str, float] = {}
        self._oldest_s: float | None = None  # quick look of the oldest capture in progress, for other threads

    def enter_stage(self, id: str, stage: str) -> ProgressEstimate:
        """Record that capture `id` has reached a stage (key of STAGES); return its progress there."""
        now_s = self._clock.now_s()
        self._reached_s.setdefault(id, {})[stage] = now_s
        self._update_oldest()
        left_s = self._left_s(id, stage, now_s)
        self._due_s[id] = now_s + left_s
        return ProgressEstimate(stage, STAGES[stage], left_s)

    def estimate(self, id: str) -> ProgressEstimate:
        """Return the progress of a capture within its stage, interpolated from the durations of the last captures."""
        now_s = self._clock.now_s()
        stage, begun_s = next(reversed(self._reached_s[id].items()))
        share = _elapsed_share(now_s - begun_s, self._due_s[id] - begun_s)
        fraction = STAGES[stage] + (_NEXT_FRACTION[stage] - STAGES[stage]) * share
        return ProgressEstimate(_ONGOING_STAGE.get(stage, stage), fraction, max(0.0, self._due_s[id] - now_s))

    def finish(self, id: str, kept: bool) -> None:
        """Remove a capture; if it was stored and no other is in progress, add its durations to the estimate."""
        now_s = self._clock.now_s()
        reached_s = self._reached_s.pop(id, {})
        self._due_s.pop(id, None)
        self._update_oldest()
        if kept and not self._due_s:  # overlapping captures have no representative durations
            for stage, at_s in reached_s.items():
                self._took_s[stage].append(now_s - at_s)

    @property
    def late_s(self) -> float:
        """Seconds by which the time since the first quick look in progress exceeds the time budget; 0.0 if none."""
        oldest_s = self._oldest_s
        return 0.0 if oldest_s is None else max(0.0, self._clock.now_s() - oldest_s - self._at_most_s())

    def _update_oldest(self) -> None:
        looked_s = (stages["quick"] for stages in self._reached_s.values() if "quick" in stages)
        self._oldest_s = min(looked_s, default=None)

    def _left_s(self, id: str, stage: str, now_s: float) -> float:
        """Return the estimated seconds until storage; except at stage `keep`, the other captures are stored first."""
        before_s = [due_s - now_s for other, due_s in self._due_s.items() if other != id] if stage != "keep" else []
        return max([0.0, *before_s]) + self._own_left_s(stage)

    def _own_left_s(self, stage: str) -> float:
        if self._took_s[stage]:
            return median(self._took_s[stage])
        default_s = {"expose": self._exposing_s + self._at_most_s(), "quick": self._at_most_s(), "keep": STORAGE_S}
        return default_s[stage]


def _elapsed_share(elapsed_s: float, estimated_s: float) -> float:
    """Return the elapsed share of a stage, 0 to 1: linear up to 0.9 at the estimated time, then asymptotic to 1."""
    if elapsed_s <= estimated_s:
        return 0.9 * elapsed_s / max(estimated_s, 1e-9)
    return 1 - 0.1 * estimated_s / elapsed_s
