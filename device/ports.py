"""What the instrument asks of its parts, in physical units: Protocols of a few verbs.

Real drivers and simulated parts fulfil the same contract, and the same tests run over both (`tests/ports/`).
"""

from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from device.values import Charge, Frame, Glow, Identity, Shot


class Camera(Protocol):
    """A sensor that turns light into counts."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every frame."""

    def expose(self, shot: Shot, into: NDArray[np.uint16] | None = None) -> Frame:
        """Take one frame whose exposure began after this call; `into` (rows, cols) is filled if it is given.

        Raises CameraMissing or CameraStalled; never returns an old frame.
        """

    def prepare(self, shot: Shot) -> None:
        """Let the exposure time of the next shot reach the sensor, in the dark: a light need not wait for it."""

    def close(self) -> None:
        """Release the sensor; closing twice is harmless."""


class Lit(Protocol):
    """A lamp that shines until this context ends."""

    def __enter__(self) -> "Lit":
        """The lamp is on."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The lamp is off, whatever happened."""


class Light(Protocol):
    """The ring of LEDs around the light path; dark unless someone holds it on."""

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark."""

    def on(self, glow: Glow) -> Lit:
        """Shine from the entry of the returned context to its end; one that is never entered stays dark.

        Raises LightFault or LightLimit, here or on entry, and is then dark.
        """

    def off(self) -> None:
        """Be dark; always allowed, harmless when it is dark already."""


class Thermometer(Protocol):
    """How warm the head is inside."""

    def read_c(self) -> float:
        """Degrees Celsius now; BusFault if it does not answer, or answers nonsense."""


class Battery(Protocol):
    """What the device runs on."""

    def read(self) -> Charge:
        """How full it is; BusFault if it does not answer, or answers nonsense."""


class HeadMemory(Protocol):
    """A few bytes that travel with the optical head: who it is, and which calibration is its own."""

    def read(self) -> Identity | None:
        """What it holds; None if nothing was ever written. BusFault if it does not answer, MemoryDamaged if torn."""

    def write(self, identity: Identity) -> None:
        """Keep this from now on, also without power; it has been read back when this returns. BusFault otherwise."""


class Button(Protocol):
    """The shutter's button on the handle."""

    def pressed_since_s(self) -> float | None:
        """The clock's moment since which it is pressed; None while it is not. BusFault if it cannot be read."""
