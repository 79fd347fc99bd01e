"""How far each picture is, told to every page, with an honest guess of the seconds that are left."""

from collections import deque
from collections.abc import Callable
from statistics import median

from device.clock import Clock
from services.instrument.bulletin import Bulletin
from services.instrument.press import Press

STAGES = {"expose": 0.1, "quick": 0.4, "keep": 0.9}  # and where the page's bar stands then
_AFTER = dict(zip(STAGES, [*list(STAGES.values())[1:], 1.0], strict=True))  # where it will stand at the next one
_BETWEEN = {"quick": "refine"}  # what is told of the time after a stage, where that is not the stage itself
KEEPING_S = 0.4
LATELY = 5  # pictures by which the next is guessed


class Progress:
    """Tells stages, and learns from each kept picture how long it took from each of them.

    `at_most_s` is what a picture is given before one was made: from its exposure, and from its quick look.
    """

    def __init__(self, bulletin: Bulletin, clock: Clock, exposing_s: float, at_most_s: Callable[[], float]) -> None:
        self._bulletin, self._clock, self._exposing_s, self._at_most_s = bulletin, clock, exposing_s, at_most_s
        self._took_s: dict[str, deque[float]] = {stage: deque(maxlen=LATELY) for stage in STAGES}
        self._reached_s: dict[str, dict[str, float]] = {}  # by capture and stage
        self._due_s: dict[str, float] = {}

    def stage(self, press: Press, id: str, stage: str, url: str | None = None) -> None:
        """A picture has come so far; it says whose press it is, for no page may take another's picture for its own."""
        now_s = self._clock.now_s()
        self._reached_s.setdefault(id, {})[stage] = now_s
        left_s = self._left_s(id, stage, now_s)
        self._due_s[id] = now_s + left_s
        facts = {"fraction": STAGES[stage], "left_s": round(left_s, 2), "url": url, "key": press.key}
        self._bulletin.tell("stage", id=id, stage=stage, **facts, **press.errand.facts)

    def goes_on(self, press: Press, id: str) -> None:
        """Between two stages a picture is as far as its time, by which the last ones were done: a guess."""
        now_s = self._clock.now_s()
        stage, begun_s = next(reversed(self._reached_s[id].items()))
        share = _share(now_s - begun_s, self._due_s[id] - begun_s)
        fraction = STAGES[stage] + (_AFTER[stage] - STAGES[stage]) * share
        left_s = max(0.0, self._due_s[id] - now_s)
        facts = {"fraction": fraction, "left_s": round(left_s, 2), "url": None, "key": press.key}
        self._bulletin.tell("stage", id=id, stage=_BETWEEN.get(stage, stage), **facts, **press.errand.facts)

    def over(self, id: str, kept: bool) -> None:
        """A picture was kept, or will never be."""
        now_s, reached_s = self._clock.now_s(), self._reached_s.pop(id, {})
        self._due_s.pop(id, None)
        if kept and not self._due_s:  # one that shared its time with another says nothing about the next
            for stage, at_s in reached_s.items():
                self._took_s[stage].append(now_s - at_s)

    @property
    def late_s(self) -> float:
        """How far the oldest picture in the making is beyond its time; 0 where none is."""
        begun_s = [min(stages.values()) for stages in list(self._reached_s.values())]
        return max(0.0, self._clock.now_s() - min(begun_s) - self._at_most_s()) if begun_s else 0.0

    def _left_s(self, id: str, stage: str, now_s: float) -> float:
        """As the last pictures took; behind another one, after that."""
        before_s = [due_s - now_s for other, due_s in self._due_s.items() if other != id] if stage != "keep" else []
        return max([0.0, *before_s]) + self._alone_s(stage)

    def _alone_s(self, stage: str) -> float:
        if self._took_s[stage]:
            return median(self._took_s[stage])
        guess_s = {"expose": 2 * self._exposing_s + self._at_most_s(), "quick": self._at_most_s(), "keep": KEEPING_S}
        return guess_s[stage]


def _share(gone_s: float, guessed_s: float) -> float:
    """How much of its time is gone: nine tenths when the guess is over, and then ever more slowly towards all of it."""
    if gone_s <= guessed_s:
        return 0.9 * gone_s / max(guessed_s, 1e-9)
    return 1 - 0.1 * guessed_s / gone_s
