"""What a lamp showed, and when: an emulated camera exposes whatever shone between two moments."""

import time

from device.values import Glow


class Timeline:
    """Stands where a SimLight expects its world; remembers every change (monotonic seconds)."""

    def __init__(self) -> None:
        self.faults: set[str] = set()
        self._changes: list[tuple[float, Glow | None]] = [(0.0, None)]

    @property
    def glow(self) -> Glow | None:
        return self._changes[-1][1]

    @glow.setter
    def glow(self, glow: Glow | None) -> None:
        self._changes.append((time.monotonic(), glow))

    def broken(self, part: str) -> bool:
        return part in self.faults

    def __call__(self, begin_s: float, end_s: float) -> list[tuple[Glow | None, float]]:
        return segments(self._changes, begin_s, end_s)


def segments(changes: list[tuple[float, Glow | None]], begin_s: float, end_s: float) -> list[tuple[Glow | None, float]]:
    """Which glow lasted how long between two moments."""
    ends = [at_s for at_s, _ in changes[1:]] + [float("inf")]
    spans = ((glow, min(end, end_s) - max(at_s, begin_s)) for (at_s, glow), end in zip(changes, ends, strict=True))
    return [(glow, span) for glow, span in spans if span > 0]
