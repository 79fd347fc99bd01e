"""What every camera driver does around one exposure: check, take, open once more after silence, say what shone."""

import logging
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from device.errors import CameraMissing, CameraStalled, FrameError
from device.spec import CameraSpec
from device.values import Counts, Frame, Glow, Shot

log = logging.getLogger(__name__)

STUCK = "Check the camera's cable, then turn the device off and on."


class Shining(Protocol):
    """Whatever says what the lamp shows now; a Light is one."""

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark."""


class Exposing(ABC):
    """A Camera, as soon as somebody says how to open its device, how to take one frame, and how to let it go.

    `_take` raises TimeoutError when no frame comes; all three raise HardwareErrors for what they understand.
    """

    def __init__(self, spec: CameraSpec, light: Shining, simulated: bool) -> None:
        self._spec, self._light, self._simulated = spec, light, simulated
        self._name = spec.sensor or spec.device
        self._number, self._closed, self._opened = 0, False, False
        self._ready_s = 0.0  # the exposure time that has arrived at the sensor

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""
        return self._spec.rows, self._spec.cols

    def expose(self, shot: Shot, into: NDArray[np.uint16] | None = None) -> Frame:
        """Take one frame whose exposure began after this call; `into` (rows, cols) is filled if it is given.

        Raises CameraMissing, CameraStalled, CameraWrong, CameraPacked, or FrameError if `into` does not fit.
        """
        if self._closed:
            raise CameraMissing("the camera has been closed")
        if into is not None and (into.shape != self.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this sensor fills uint16 {self.shape}")
        counts = np.empty(self.shape, np.uint16) if into is None else into
        before = self._light.glow
        if not self._opened:
            self.open(shot)
        try:
            self._take(shot, counts)
        except TimeoutError:
            self._begin_again(shot, counts, before)
        after = self._light.glow
        self._number, self._ready_s = self._number + 1, shot.exposure_s
        return Frame(counts, shot.exposure_s, self._number, before if before == after else None, self._simulated)

    def prepare(self, shot: Shot) -> None:
        """Let the exposure time of the next shot arrive at the sensor before anybody switches on a light for it."""
        if shot.exposure_s != self._ready_s:
            self.expose(shot)

    def close(self) -> None:
        """Release the sensor; closing twice is harmless."""
        self._closed = True
        self._release()

    def open(self, shot: Shot) -> None:
        """Open the device and look at a first frame; whatever fails, nothing stays open."""
        try:
            self._open(shot)
            self._opened = True
            self._take(shot, None)
        except TimeoutError as error:
            self._release()
            raise CameraStalled(f"the {self._name} was opened and gives no frames", STUCK) from error
        except BaseException:
            self._release()
            raise

    def _begin_again(self, shot: Shot, counts: Counts, before: Glow | None) -> None:
        """No frame came: open the camera once more; a frame in another light than at the beginning is not given."""
        log.warning("the %s is silent: opening it again", self._name)
        self._release()
        self.open(shot)
        try:
            self._take(shot, counts)
        except TimeoutError as error:
            self._release()
            raise CameraStalled(f"the {self._name} gives no frames, also after a new start", STUCK) from error
        if self._light.glow != before:
            raise CameraStalled("the camera fell silent while the lamp shone; it runs again", "Take the picture again.")

    def _release(self) -> None:
        self._opened = False
        self._let_go()

    @abstractmethod
    def _open(self, shot: Shot) -> None: ...

    @abstractmethod
    def _take(self, shot: Shot, counts: Counts | None) -> None:
        """The next frame that began after this call, into `counts`; None: the first frame, which is only looked at."""

    @abstractmethod
    def _let_go(self) -> None:
        """Close whatever is open; harmless when nothing is."""
