"""Ring of APA102 LEDs on SPI: on within a context, off before and after it, and off if this process ends.

The LEDs keep their last colour while they have power. So a guardian process receives a lease before each light, and
turns the ring off when the lease expires or this process ends.
"""

import logging
from collections.abc import Sequence
from threading import Lock
from types import TracebackType
from typing import Any, Protocol

from device.config.head_file import ChainSpec
from device.drivers.blank import SPEED_HZ, dark_frame
from device.drivers.guardian import Guardian
from device.errors import LightFault
from device.optics.matrix import ring
from device.values import Colour, Illumination

log = logging.getLogger(__name__)

FULL = 255
GLOBAL = 0xFF  # 0b111 and 31: smaller values add a second, slow PWM that beats with the exposure
BLUE_GREEN_RED: tuple[Colour, Colour, Colour] = ("blue", "green", "red")  # byte order on the bus


def lit_frame(chain: ChainSpec, leds: Sequence[int], glow: Illumination) -> bytes:
    """Return the SPI frame that lights only these LEDs (chain indices), at level times trim, at least 1/255."""
    frame = bytearray(dark_frame(chain.rows * chain.cols))
    channel = 1 + BLUE_GREEN_RED.index(glow.colour)
    for place, led in enumerate(leds):
        trim = chain.trims[place] if chain.trims else 1.0
        frame[4 + 4 * led + channel] = max(1, round(FULL * glow.level * trim))
    return bytes(frame)


class Pulse(Protocol):
    """Heartbeat that keeps the hardware gate open while a lease is active (device/drivers/heartbeat.py)."""

    def start(self, lease_s: float) -> None:
        """Start the heartbeat, for at most `lease_s` seconds; the LEDs have power on return."""

    def stop(self) -> None:
        """Stop the heartbeat."""


class Apa102Ring:
    """APA102 driver that implements `ports.Light` on the LEDs of `chain`; LightFault if bus or guardian is unusable."""

    def __init__(self, chain: ChainSpec, guardian: Guardian, lease_s: float, pulse: Pulse | None = None) -> None:
        try:
            import spidev
        except Exception as error:  # of another numpy's compiled part: ValueError
            raise LightFault(f"spidev cannot be used: {error}", "Install python3-spidev.") from error
        self._chain, self._guardian, self._lease_s = chain, guardian, lease_s
        self._leds, self._pulse = ring(chain), pulse
        self._dark = dark_frame(chain.rows * chain.cols)
        self._glow: Illumination | None = None
        self._lock = Lock()  # the guard's timer may turn the ring off while another thread turns it on
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
    def illumination(self) -> Illumination | None:
        """Return the current illumination; None when it is off."""
        return self._glow

    def on(self, glow: Illumination) -> "RingLightContext":
        """Return a context in which the ring is on; LightFault on entry if that fails, and the ring is then off."""
        return RingLightContext(self, glow)

    def off(self) -> None:
        """Turn the ring off, stop the heartbeat, cancel the lease; harmless if off or closed. Raises LightFault."""
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
            self._guardian.end_lease()

    def turn_on(self, glow: Illumination) -> None:
        """Grant the lease, start the heartbeat, then turn the ring on; LightFault. Called by RingLightContext only."""
        with self._lock:
            self._guardian.grant_lease(self._lease_s)
            if self._pulse is not None:
                self._pulse.start(self._lease_s)
                self._send(self._dark)  # LEDs show arbitrary colours after power-up
            self._glow = glow
            self._send(lit_frame(self._chain, self._leds, glow))

    def close(self) -> None:
        """Turn the ring off, close the SPI device and end the guardian; closing twice is harmless."""
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
        except (OSError, SystemError) as error:  # spidev raises SystemError for a short write
            raise LightFault(f"the lamp's bus does not take its message: {error}") from error


class RingLightContext:
    """Context manager: the ring is on from entry to exit."""

    def __init__(self, ring: Apa102Ring, glow: Illumination) -> None:
        self._ring, self._glow = ring, glow

    def __enter__(self) -> "RingLightContext":
        """Turn the ring on; after an error turn it off again and raise the error."""
        try:
            self._ring.turn_on(self._glow)
        except BaseException:
            self._ring.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Turn the ring off, also after an exception."""
        self._ring.off()
