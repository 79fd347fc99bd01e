"""Record of a lamp's illumination over time, from which an emulated camera integrates its exposure."""

import time

from device.values import Illumination


class Timeline:
    """Replacement of a SimLight's world that records every change with its time (monotonic seconds)."""

    def __init__(self) -> None:
        self.faults: set[str] = set()
        self._changes: list[tuple[float, Illumination | None]] = [(0.0, None)]

    @property
    def illumination(self) -> Illumination | None:
        return self._changes[-1][1]

    @illumination.setter
    def illumination(self, illumination: Illumination | None) -> None:
        self._changes.append((time.monotonic(), illumination))

    def has_fault(self, part: str) -> bool:
        return part in self.faults

    def __call__(self, begin_s: float, end_s: float) -> list[tuple[Illumination | None, float]]:
        return segments(self._changes, begin_s, end_s)


def segments(
    changes: list[tuple[float, Illumination | None]], begin_s: float, end_s: float
) -> list[tuple[Illumination | None, float]]:
    """Return each illumination between two moments with its duration, s."""
    ends = [at_s for at_s, _ in changes[1:]] + [float("inf")]
    spans = (
        (illumination, min(end, end_s) - max(at_s, begin_s))
        for (at_s, illumination), end in zip(changes, ends, strict=True)
    )
    return [(illumination, span) for illumination, span in spans if span > 0]
