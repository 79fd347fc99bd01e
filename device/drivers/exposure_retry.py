"""Common part of the camera drivers: one exposure, with one reopening of the camera after a timeout."""

import logging
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from device.config.head_file import CameraSpec
from device.errors import CameraMissing, CameraStalled, FrameError
from device.values import Counts, ExposureSettings, Frame, Illumination

log = logging.getLogger(__name__)

FRAME_TIMEOUT_S = 2.0  # of a frame, after its exposure
FIRST_FRAME = 5  # factor of the timeout for the check frame of the first opening: then the computer starts, too
CABLE_REMEDY = "Check the camera's cable, then turn the device off and on."


class LampState(Protocol):
    """Source of the current illumination, such as a Light."""

    @property
    def illumination(self) -> Illumination | None:
        """Return the current illumination; None when the lamp is off."""


class RetryingCamera(ABC):
    """Camera base class; a driver implements `_open`, `_take` (one frame) and `_close_device`.

    `_take` raises TimeoutError when no frame arrives; all three raise HardwareError for known faults. `light` is the
    source of each frame's illumination; `patience_s` is the timeout for a frame after its exposure.
    """

    def __init__(self, spec: CameraSpec, light: LampState, simulated: bool, patience_s: float) -> None:
        self._spec, self._light, self._simulated = spec, light, simulated
        self._name = spec.sensor or spec.device
        self._patience_s = patience_s
        self._number = 0
        self._closed = False
        self._opened = False
        self._ready_s = 0.0  # the exposure time that the sensor uses now

    @property
    def shape(self) -> tuple[int, int]:
        """Return (rows, cols) of every frame."""
        return self._spec.rows, self._spec.cols

    @property
    def facts(self) -> dict[str, str]:
        """Return properties of the opened sensor for a technician; none by default."""
        return {}

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        """Return one frame whose exposure began after this call; `into` (rows, cols) uint16 is filled if it is given.

        Its illumination is None if the lamp changed during the call. Raises CameraMissing, CameraStalled,
        CameraMismatch, CameraPacked, or FrameError if `into` does not fit.
        """
        if self._closed:
            raise CameraMissing("the camera has been closed")
        if into is not None and (into.shape != self.shape or into.dtype != np.uint16):
            raise FrameError(f"the buffer is {into.dtype} {into.shape}; this sensor fills uint16 {self.shape}")
        counts = np.empty(self.shape, np.uint16) if into is None else into
        before = self._light.illumination
        if not self._opened:
            self.open(shot)
        try:
            self._take(shot, counts)
        except TimeoutError:
            self._retry_once(shot, counts, before)
        after = self._light.illumination
        self._number = self._number + 1
        self._ready_s = shot.exposure_s
        return Frame(counts, shot.exposure_s, self._number, before if before == after else None, self._simulated)

    def prepare(self, shot: ExposureSettings) -> None:
        """Set the exposure time of the next frame before the light is on; a change takes and discards one frame."""
        if shot.exposure_s != self._ready_s:
            self.expose(shot)

    def close(self) -> None:
        """Close the camera; closing twice is harmless."""
        self._closed = True
        self._release()

    def open(self, shot: ExposureSettings) -> None:
        """Open the device and check a first frame; CameraStalled without one. After any error the device is closed."""
        try:
            self._open(shot)
            self._opened = True
            self._take(shot, None)
        except TimeoutError as error:
            self._release()
            raise CameraStalled(f"the {self._name} was opened and gives no frames", CABLE_REMEDY) from error
        except BaseException:
            self._release()
            raise

    def _timeout_s(self, shot: ExposureSettings, counts: Counts | None) -> float:
        """Return the timeout in s for a frame; longer for the check frame (`counts` is None) of the first opening."""
        is_first = counts is None and self._number == 0
        return shot.exposure_s + self._patience_s * (FIRST_FRAME if is_first else 1)

    def _retry_once(self, shot: ExposureSettings, counts: Counts, before: Illumination | None) -> None:
        """Reopen the camera and take the frame into `counts`; CameraStalled if none arrives or the light changed."""
        log.warning("%s: no frame before the timeout, reopening the camera", self._name)
        self._release()
        self.open(shot)
        try:
            self._take(shot, counts)
        except TimeoutError as error:
            self._release()
            raise CameraStalled(f"the {self._name} gives no frames, also after a new start", CABLE_REMEDY) from error
        if self._light.illumination != before:
            raise CameraStalled("the camera fell silent while the lamp shone; it runs again", "Take the picture again.")

    def _release(self) -> None:
        self._opened = False
        self._close_device()

    @abstractmethod
    def _open(self, shot: ExposureSettings) -> None: ...

    @abstractmethod
    def _take(self, shot: ExposureSettings, counts: Counts | None) -> None:
        """Write the next frame that began after this call into `counts`; None: check a first frame only."""

    @abstractmethod
    def _close_device(self) -> None:
        """Close the device; harmless if it is not open."""
