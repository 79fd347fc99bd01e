"""Camera tap: a camera wrapper that publishes some of its raw frames as JPEG pictures with their levels."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Condition

import numpy as np

from device.clock import Clock
from device.config.head_file import CameraSpec
from device.ports import Camera
from device.values import Counts, ExposureSettings, Frame
from services.imaging.picture_files import counts_jpeg

WANTED_S = 3.0  # pictures are made this long after the last request
EVERY_S = 0.2
LONGEST_SIDE_PX = 960
DIM, FULL = 0.3, 0.95  # share of the ADC range: outside it, `take_preview` changes the exposure
SHORTEST_S = 1e-3  # the longest as a multiple of the exposure of a capture
LONGEST = 4


@dataclass(frozen=True)
class TapPicture:
    """Raw picture: number, JPEG, time (clock seconds), exposure time and levels in counts.

    `brightest_dn` is the 99.9th percentile, `full` the share of saturated pixels.
    """

    number: int
    jpeg: bytes
    seen_s: float
    exposure_s: float
    brightest_dn: float
    mean_dn: float
    full: float


class CameraTap:
    """Camera that delegates to `camera` and publishes frames as JPEG preview pictures while a client requests them.

    Only the latest picture is kept; at most one is made per EVERY_S. `before_frame` is called before every exposure;
    its exceptions cancel the exposure. The mutex of `_condition` guards writes of `_picture`,
    `_watched_until_s` and `_closed`.
    """

    def __init__(self, camera: Camera, spec: CameraSpec, clock: Clock, before_frame: Callable[[], None]) -> None:
        self._camera, self._spec, self._clock, self._each = camera, spec, clock, before_frame
        self._condition = Condition()
        self._watched_until_s = 0.0
        self._closed = False
        self._picture = TapPicture(0, b"", float("-inf"), 0.0, 0.0, 0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self._camera.shape

    @property
    def facts(self) -> Mapping[str, str]:
        """Properties of the wrapped camera's sensor."""
        return self._camera.facts

    def prepare(self, shot: ExposureSettings) -> None:
        """Set the exposure time of the next frame on the wrapped camera."""
        self._camera.prepare(shot)

    def expose(self, shot: ExposureSettings, into: Counts | None = None) -> Frame:
        """Return one frame of the wrapped camera; publish it if pictures are requested and the last is EVERY_S old."""
        self._each()
        frame = self._camera.expose(shot, into)
        now_s = self._clock.now_s()
        if self.wanted and now_s - self._picture.seen_s >= EVERY_S:
            self._publish(frame, now_s)
        return frame

    def close(self) -> None:
        """Wake all waiting readers; the wrapped camera stays open."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    @property
    def wanted(self) -> bool:
        """Whether a client requested a picture within the last WANTED_S."""
        return self._clock.now_s() < self._watched_until_s

    def next_picture(self, after: int, wait_s: float = 2.0) -> TapPicture | None:
        """Request pictures; return the next one with a number above `after`, None after `wait_s` seconds or `close`."""
        with self._condition:
            self._watched_until_s = self._clock.now_s() + WANTED_S
            self._condition.wait_for(lambda: self._picture.number > after or self._closed, wait_s)
            return self._picture if self._picture.number > after else None

    def take_preview(self, exposure_s: float) -> float:
        """Take one frame at `exposure_s` and return the exposure time for the next one, seconds.

        Halved if the frame is brighter than FULL, doubled if it is darker than DIM, within limits; else unchanged.
        """
        self.prepare(ExposureSettings(exposure_s))
        frame = self.expose(ExposureSettings(exposure_s))
        black_dn = self._spec.black_dn
        white_dn = self._spec.white_dn
        share = (_brightest_dn(frame.counts) - black_dn) / (white_dn - black_dn)
        if share > FULL:
            return max(exposure_s / 2, SHORTEST_S)
        return min(exposure_s * 2, LONGEST * self._spec.exposure_s) if share < DIM else exposure_s

    def _publish(self, frame: Frame, now_s: float) -> None:
        counts = frame.counts
        white_dn = self._spec.white_dn
        jpeg = counts_jpeg(counts, self._spec.black_dn, white_dn, LONGEST_SIDE_PX, frame.simulated)
        levels = _brightest_dn(counts), float(counts.mean()), float(np.mean(counts >= white_dn))
        with self._condition:
            self._picture = TapPicture(self._picture.number + 1, jpeg, now_s, frame.exposure_s, *levels)
            self._condition.notify_all()


def _brightest_dn(counts: Counts) -> float:
    """Return the 99.9th percentile of one pixel in four, counts; single hot pixels have no effect."""
    return float(np.percentile(counts[::2, ::2], 99.9))
