"""Ports of the instrument's parts in physical units: Protocols for camera, light, sensors, memory and button.

Real drivers and simulated parts fulfil the same contract; the same tests run over both (`tests/ports/`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from device.values import BatteryState, ExposureSettings, Frame, HeadIdentity, Illumination


class Camera(Protocol):
    """Image sensor that returns raw counts."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""

    @property
    def facts(self) -> Mapping[str, str]:
        """Properties of the opened sensor for a technician, such as `sensor` and `format`; empty if none are known."""

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        """Return one frame whose exposure began after this call; `into` (rows, cols) is filled if given.

        Raises CameraMissing or CameraStalled; never returns an old frame.
        """

    def prepare(self, shot: ExposureSettings) -> None:
        """Set the exposure time of the next frame on the sensor ahead of time, in the dark."""

    def close(self) -> None:
        """Release the sensor; idempotent."""


class LightContext(Protocol):
    """Context manager during which the lamp is on."""

    def __enter__(self) -> "LightContext":
        """Turn the lamp on."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Turn the lamp off, also after an exception."""


class Light(Protocol):
    """Ring of LEDs around the light path; dark outside a context of `on`."""

    @property
    def illumination(self) -> Illumination | None:
        """Present illumination; None when dark."""

    def on(self, illumination: Illumination) -> LightContext:
        """Return a context during which the lamp is on; a context that is never entered stays dark.

        Raises LightFault or LightLimit, here or on entry, and is then dark.
        """

    def off(self) -> None:
        """Turn the lamp off; always allowed, idempotent."""


class Thermometer(Protocol):
    """Temperature sensor inside the head."""

    def read_c(self) -> float:
        """Return the temperature, degrees Celsius; BusFault without an answer or with an implausible one."""


class Battery(Protocol):
    """Battery gauge of the device."""

    def read(self) -> BatteryState:
        """Return the battery's state; BusFault without an answer or with an implausible one."""


class HeadMemory(Protocol):
    """Non-volatile memory in the optical head: serial number and id of its calibration."""

    def read(self) -> HeadIdentity | None:
        """Return the stored identity, None if never written.

        BusFault without an answer, MemoryDamaged if the content is incomplete.
        """

    def write(self, identity: HeadIdentity) -> None:
        """Store the identity in non-volatile memory and verify it by reading back; BusFault on failure."""


@dataclass(frozen=True)
class Chips:
    """Chips of a head; None for each that the head does not have."""

    thermometer: Thermometer | None = None
    battery: Battery | None = None
    memory: HeadMemory | None = None


NO_CHIPS = Chips()


class Button(Protocol):
    """Shutter button on the handle."""

    def pressed_since_s(self) -> float | None:
        """Return the clock time since which the button is pressed, None while released; BusFault if unreadable."""
