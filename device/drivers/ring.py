"""The ring of APA102 LEDs on SPI: lit inside a context, dark before and after it, and dark if this process is gone.

The LEDs keep their last colour while they have power. So every light is announced to a guardian, a process of its own,
before it shines: it darkens when the lease runs out, or when this process is gone.
"""

import logging
from collections.abc import Sequence
from threading import Lock
from types import TracebackType
from typing import Any, Protocol

from device.drivers.blank import SPEED_HZ, dark_frame
from device.drivers.guardian import Guardian
from device.errors import LightFault
from device.optics.matrix import ring
from device.spec import ChainSpec
from device.values import Colour, Glow

log = logging.getLogger(__name__)

FULL = 255
GLOBAL = 0xFF  # 0b111 and 31: a smaller one is a second, slow PWM that beats with the shutter
BLUE_GREEN_RED: tuple[Colour, Colour, Colour] = ("blue", "green", "red")  # as they follow on the wire


def lit_frame(chain: ChainSpec, leds: Sequence[int], glow: Glow) -> bytes:
    """The message that shows `glow` on these LEDs and nothing on the others; each by its own trim, never quite dark."""
    frame = bytearray(dark_frame(chain.rows * chain.cols))
    channel = 1 + BLUE_GREEN_RED.index(glow.colour)
    for place, led in enumerate(leds):
        trim = chain.trims[place] if chain.trims else 1.0
        frame[4 + 4 * led + channel] = max(1, round(FULL * glow.level * trim))
    return bytes(frame)


class Pulse(Protocol):
    """What holds the hardware gate open while a lease is live (device/drivers/heartbeat.py)."""

    def start(self, lease_s: float) -> None:
        """Beat from now, at most for `lease_s` seconds; the LEDs have power when this returns."""

    def stop(self) -> None:
        """Be still."""


class Apa102Ring:
    """The lamp that `chain` describes. Raises LightFault when the chain cannot be reached, or not be kept safe."""

    def __init__(self, chain: ChainSpec, guardian: Guardian, lease_s: float, pulse: Pulse | None = None) -> None:
        try:
            import spidev
        except ImportError as error:
            raise LightFault(f"spidev cannot be used: {error}", "Install python3-spidev.") from error
        self._chain, self._guardian, self._lease_s = chain, guardian, lease_s
        self._leds, self._pulse = ring(chain), pulse
        self._dark = dark_frame(chain.rows * chain.cols)
        self._glow: Glow | None = None
        self._lock = Lock()  # the guard's timer may darken while the owner of the head lights up
        self._wire: Any = spidev.SpiDev()
        try:
            bus, select = chain.device.removeprefix("/dev/spidev").split(".")
            self._wire.open(int(bus), int(select))
            self._wire.mode = 0
            self._wire.max_speed_hz = SPEED_HZ
        except (OSError, ValueError) as error:
            raise LightFault(f"{chain.device} cannot be opened: {error}") from error
        self.off()

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark."""
        return self._glow

    def on(self, glow: Glow) -> "RingLit":
        """Shine from the entry of the returned context to its end; LightFault, on entry, if it cannot, and is dark."""
        return RingLit(self, glow)

    def off(self) -> None:
        """Be dark; always allowed, harmless when dark or closed already. LightFault if the chain does not listen."""
        with self._lock:
            if self._wire is None:
                return
            self._glow = None
            try:
                self._send(self._dark)
                self._send(self._dark)
            finally:
                if self._pulse is not None:
                    self._pulse.stop()
            self._guardian.dark()

    def shine(self, glow: Glow) -> None:
        """Shine now, once the guardian knows; for the context only."""
        with self._lock:
            self._guardian.lit(self._lease_s)
            if self._pulse is not None:
                self._pulse.start(self._lease_s)
                self._send(self._dark)  # LEDs that had no power show anything
            self._glow = glow
            self._send(lit_frame(self._chain, self._leds, glow))

    def close(self) -> None:
        """Be dark, and let the bus and the guardian go; closing twice is harmless."""
        if self._wire is None:
            return
        try:
            self.off()
        finally:
            self._wire.close()
            self._wire = None
            self._guardian.close()

    def _send(self, frame: bytes) -> None:
        try:
            self._wire.writebytes2(frame)
        except (OSError, SystemError) as error:  # spidev answers a short write with the latter
            raise LightFault(f"the lamp's bus does not take its message: {error}") from error


class RingLit:
    """The time in which the ring shines."""

    def __init__(self, ring: Apa102Ring, glow: Glow) -> None:
        self._ring, self._glow = ring, glow

    def __enter__(self) -> "RingLit":
        """The ring is on."""
        try:
            self._ring.shine(self._glow)
        except BaseException:
            self._ring.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The ring is off, whatever happened."""
        self._ring.off()
