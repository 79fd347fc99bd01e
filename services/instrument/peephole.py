"""A camera through which others may look while its owner measures: raw frames as pictures, and how bright they are."""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Condition

import numpy as np

from device.clock import Clock
from device.ports import Camera
from device.spec import CameraSpec
from device.values import Counts, Frame, Shot
from services.records.picture import counts_jpeg

WANTED_S = 3.0  # pictures are made this long after somebody last asked for one
EVERY_S = 0.2
LONGEST_SIDE_PX = 960
DIM, FULL = 0.3, 0.95  # of the converter: what is darker or brighter is shown with another exposure
SHORTEST_S, LONGEST = 1e-3, 4  # the longest in exposures of a picture


@dataclass(frozen=True)
class Sight:
    """One raw picture: its number and JPEG, when it was seen, and its levels; `full` is the share of full pixels."""

    number: int
    jpeg: bytes
    seen_s: float
    exposure_s: float
    brightest_dn: float
    mean_dn: float
    full: float


class Peephole:
    """A Camera that does what the one behind it does, and shows some of its frames; `each` is called before every one.

    What `each` raises ends the exposure before it begins.
    """

    def __init__(self, camera: Camera, spec: CameraSpec, clock: Clock, each: Callable[[], None]) -> None:
        self._camera, self._spec, self._clock, self._each = camera, spec, clock, each
        self._turn = Condition()
        self._wanted_until_s = 0.0
        self._closed = False
        self._last = Sight(0, b"", float("-inf"), 0.0, 0.0, 0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self._camera.shape

    def prepare(self, shot: Shot) -> None:
        """Be set to this exposure."""
        self._camera.prepare(shot)

    def expose(self, shot: Shot, into: Counts | None = None) -> Frame:
        """One frame of the camera behind, perhaps shown."""
        self._each()
        frame = self._camera.expose(shot, into)
        now_s = self._clock.now_s()
        if self.wanted and now_s - self._last.seen_s >= EVERY_S:
            self._show(frame, now_s)
        return frame

    def close(self) -> None:
        """Nobody looks through any more; the camera behind belongs to somebody else."""
        with self._turn:
            self._closed = True
            self._turn.notify_all()

    @property
    def wanted(self) -> bool:
        """Whether somebody looks."""
        return self._clock.now_s() < self._wanted_until_s

    def look(self, after: int, wait_s: float = 2.0) -> Sight | None:
        """The next picture after number `after`; None when none comes in `wait_s`."""
        with self._turn:
            self._wanted_until_s = self._clock.now_s() + WANTED_S
            self._turn.wait_for(lambda: self._last.number > after or self._closed, wait_s)
            return self._last if self._last.number > after else None

    def glance(self, exposure_s: float) -> float:
        """Take one frame for whoever looks, and say which exposure would show the next one better."""
        self.prepare(Shot(exposure_s))
        frame = self.expose(Shot(exposure_s))
        black_dn, white_dn = self._spec.black_dn, self._spec.white_dn
        share = (_brightest_dn(frame.counts) - black_dn) / (white_dn - black_dn)
        if share > FULL:
            return max(exposure_s / 2, SHORTEST_S)
        return min(exposure_s * 2, LONGEST * self._spec.exposure_s) if share < DIM else exposure_s

    def _show(self, frame: Frame, now_s: float) -> None:
        counts, white_dn = frame.counts, self._spec.white_dn
        jpeg = counts_jpeg(counts, self._spec.black_dn, white_dn, LONGEST_SIDE_PX, frame.simulated)
        levels = _brightest_dn(counts), float(counts.mean()), float(np.mean(counts >= white_dn))
        with self._turn:
            self._last = Sight(self._last.number + 1, jpeg, now_s, frame.exposure_s, *levels)
            self._turn.notify_all()


def _brightest_dn(counts: Counts) -> float:
    """The brightest of a sample of pixels but one in a thousand: some are always bright, light or no light."""
    return float(np.percentile(counts[::2, ::2], 99.9))
