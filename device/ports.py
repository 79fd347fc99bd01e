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
        """Return one frame whose exposure began after this call, never an old one.

        Parameters
        ----------
        shot
            Exposure time, above 0 and up to 10 s.
        into
            Buffer (rows, cols) that becomes the counts of the frame.

        Returns
        -------
        Frame
            Raw counts, uint16 (rows, cols).

        Raises
        ------
        CameraMissing
            The camera does not answer.
        CameraStalled
            It answers, and no frame arrives.
        """

    def prepare(self, shot: ExposureSettings) -> None:
        """Set the exposure time of the next frame on the sensor ahead of time, in the dark.

        Parameters
        ----------
        shot
            Exposure time, above 0 and up to 10 s.
        """

    def close(self) -> None:
        """Release the sensor. A second call does nothing."""


class LightContext(Protocol):
    """Context manager during which the lamp is on."""

    def __enter__(self) -> "LightContext":
        """Turn the lamp on."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Turn the lamp off, also after an exception."""


class Light(Protocol):
    """Ring of LEDs around the light path, which is dark outside of a context of `on`."""

    @property
    def illumination(self) -> Illumination | None:
        """Present illumination; None when dark."""

    def on(self, illumination: Illumination) -> LightContext:
        """Return a context during which the lamp is on.

        A context that is never entered stays dark. After an error, here or on entry, the lamp is dark.

        Parameters
        ----------
        illumination
            Colour, and level above 0 and up to 1 (full drive).

        Returns
        -------
        LightContext
            Context that turns the lamp on and off.

        Raises
        ------
        LightFault
            The lamp cannot be driven.
        LightLimit
            The light would exceed a limit of the eye.
        """

    def off(self) -> None:
        """Turn the lamp off. It is always allowed, and a second call does nothing."""


class Thermometer(Protocol):
    """Temperature sensor inside the head."""

    def read_c(self) -> float:
        """Return the temperature of the head.

        Returns
        -------
        float
            Temperature in degrees Celsius.

        Raises
        ------
        BusFault
            No answer, or an implausible one.
        """


class Battery(Protocol):
    """Battery gauge of the device."""

    def read(self) -> BatteryState:
        """Return the battery's state.

        Returns
        -------
        BatteryState
            Charge as a fraction, 0 to 1, and voltage in V.

        Raises
        ------
        BusFault
            No answer, or an implausible one.
        """


class HeadMemory(Protocol):
    """Non-volatile memory in the optical head: serial number and id of its calibration."""

    def read(self) -> HeadIdentity | None:
        """Return the stored identity of the head.

        Returns
        -------
        HeadIdentity or None
            Serial number and id of the calibration; None if nothing was written yet.

        Raises
        ------
        BusFault
            No answer.
        MemoryDamaged
            The content is incomplete.
        """

    def write(self, identity: HeadIdentity) -> None:
        """Store the identity of the head in non-volatile memory, and verify it by reading it back.

        Parameters
        ----------
        identity
            Serial number and id of the calibration.

        Raises
        ------
        BusFault
            No answer, or other content than was written.
        """


@dataclass(frozen=True)
class Chips:
    """Chips of a head, None for each that it does not have.

    Attributes
    ----------
    thermometer
        Temperature sensor inside the head.
    battery
        Battery gauge.
    memory
        Memory with the head's identity.
    """

    thermometer: Thermometer | None = None
    battery: Battery | None = None
    memory: HeadMemory | None = None


NO_CHIPS = Chips()


class Button(Protocol):
    """Shutter button on the handle."""

    def pressed_since_s(self) -> float | None:
        """Return since when the button is pressed.

        Returns
        -------
        float or None
            Time of the clock in s; None while the button is released.

        Raises
        ------
        BusFault
            The button cannot be read.
        """
