"""Rings of LEDs on SPI: on within a context, off before and after it, and off if this process ends.

APA102 LEDs and TLC5971 drivers keep their last state while they have power. So a guardian process receives a lease
before each light, and turns the ring off when the lease expires or this process ends.
"""

import logging
from collections.abc import Sequence
from threading import Lock
from types import TracebackType
from typing import Protocol

from device.config.head_file import OUTPUTS, ChainSpec, SinkSpec
from device.drivers.blank import dark_frame, dark_packets
from device.drivers.guardian import Guardian
from device.drivers.spi_bus import SpiBus
from device.errors import LightFault
from device.optics.matrix import ring
from device.values import Colour, Illumination

log = logging.getLogger(__name__)

FULL = 255
BLUE_GREEN_RED: tuple[Colour, Colour, Colour] = ("blue", "green", "red")  # byte order on the bus


def lit_frame(chain: ChainSpec, leds: Sequence[int], illumination: Illumination) -> bytes:
    """Return the SPI frame that lights only these LEDs (chain indices), at level times trim, at least 1/255."""
    frame = bytearray(dark_frame(chain.rows * chain.cols))
    channel = 1 + BLUE_GREEN_RED.index(illumination.colour)
    for place, led in enumerate(leds):
        trim = chain.trims[place] if chain.trims else 1.0
        frame[4 + 4 * led + channel] = max(1, round(FULL * illumination.level * trim))
    return bytes(frame)


# One TLC5971 packet, 224 bits, most significant first (TI SBVS146D, 9.2.2.3): write command 25h; OUTTMG, EXTGCK,
# TMGRST, DSPRPT, BLANK; brightness of blue, green, red, 7 bits each; grey scales B3, G3, R3, B2 ... R0, 16 bits each.
COMMAND, FULL_BRIGHTNESS, GREY_MAX = 0x25, 0x7F, 0xFFFF
LIT_CONTROL = (
    0b10110  # outputs change at the clock's rising edge, internal clock, restart at the latch, repeat, no blank
)


def lit_packets(sinks: SinkSpec, illumination: Illumination) -> bytes:
    """Return the message that lights the LEDs of one colour, at level times trim, at least 1/65535.

    LightFault for a colour that the ring does not have. The packet of the last chip comes first; chip 0 is that at the
    computer, and its outputs 0 to 11 are R0, G0, B0, R1 ... B3.
    """
    if illumination.colour not in sinks.colours:
        raise LightFault(f"this ring has no {illumination.colour} LEDs", "Correct light.colour in the head file.")
    leds = sinks.colours[illumination.colour]
    greys = [0] * (OUTPUTS * sinks.chips)
    for outputs, trim in zip(leds.outputs, leds.trims or (1.0,) * len(leds.outputs), strict=True):
        for output in outputs:
            greys[output] = max(1, round(GREY_MAX * illumination.level * trim))
    head = (COMMAND << 5 | LIT_CONTROL) << 21 | FULL_BRIGHTNESS << 14 | FULL_BRIGHTNESS << 7 | FULL_BRIGHTNESS
    return b"".join(
        head.to_bytes(4, "big") + b"".join(grey.to_bytes(2, "big") for grey in reversed(greys[first : first + OUTPUTS]))
        for first in range(OUTPUTS * (sinks.chips - 1), -1, -OUTPUTS)
    )


class Pulse(Protocol):
    """Heartbeat that keeps the hardware gate open while a lease is active (device/drivers/heartbeat.py)."""

    def start(self, lease_s: float) -> None:
        """Start the heartbeat, for at most `lease_s` seconds; the LEDs have power on return."""

    def stop(self) -> None:
        """Stop the heartbeat."""


class LedRing:
    """Driver of a chain of LEDs on SPI that implements `ports.Light`; LightFault if bus or guardian is unusable.

    Subclasses give the message that lights the ring; `dark` is the one that turns it off.
    """

    def __init__(self, device: str, dark: bytes, guardian: Guardian, lease_s: float, pulse: Pulse | None) -> None:
        self._dark, self._guardian, self._lease_s, self._pulse = dark, guardian, lease_s, pulse
        self._illumination: Illumination | None = None
        self._lock = Lock()  # the guard's timer may turn the ring off while another thread turns it on
        self._bus: SpiBus | None = SpiBus(device)
        self.off()

    def _lit(self, illumination: Illumination) -> bytes:
        """Return the message that lights the ring; LightFault for a colour that it does not have."""
        raise NotImplementedError

    @property
    def illumination(self) -> Illumination | None:
        """Return the current illumination; None when it is off."""
        return self._illumination

    def on(self, illumination: Illumination) -> "RingLightContext":
        """Return a context in which the ring is on; LightFault on entry if that fails, and the ring is then off."""
        return RingLightContext(self, illumination)

    def off(self) -> None:
        """Turn the ring off, stop the heartbeat, cancel the lease; harmless if off or closed. Raises LightFault."""
        with self._lock:
            if self._bus is None:
                return
            self._illumination = None
            try:
                self._bus.send(self._dark)
                self._bus.send(self._dark)
            finally:
                if self._pulse is not None:
                    self._pulse.stop()
            self._guardian.end_lease()

    def turn_on(self, illumination: Illumination) -> None:
        """Grant the lease, start the heartbeat, then turn the ring on; LightFault. Called by RingLightContext only."""
        with self._lock:
            if self._bus is None:
                raise LightFault("the lamp has been closed")
            frame = self._lit(illumination)
            self._guardian.grant_lease(self._lease_s)
            if self._pulse is not None:
                self._pulse.start(self._lease_s)
                self._bus.send(self._dark)  # LEDs show arbitrary colours after power-up
            self._illumination = illumination
            self._bus.send(frame)

    def close(self) -> None:
        """Turn the ring off, close the SPI device and end the guardian; closing twice is harmless."""
        if self._bus is None:
            return
        try:
            self.off()
        finally:
            self._bus.close()
            self._bus = None
            self._guardian.close()


class Apa102Ring(LedRing):
    """Ring of a matrix of APA102 LEDs: for benches and model eyes, its light is too weak for an eye (OPTICS.md 4.6)."""

    def __init__(self, chain: ChainSpec, guardian: Guardian, lease_s: float, pulse: Pulse | None = None) -> None:
        self._chain = chain
        self._leds = ring(chain)
        super().__init__(chain.device, dark_frame(chain.rows * chain.cols), guardian, lease_s, pulse)

    def _lit(self, illumination: Illumination) -> bytes:
        if illumination.colour not in BLUE_GREEN_RED:
            raise LightFault(f"an APA102 has no {illumination.colour} LED", "Correct light.colour in the head file.")
        return lit_frame(self._chain, self._leds, illumination)


class Tlc5971Ring(LedRing):
    """Ring of high-power LEDs behind TLC5971 constant-current drivers, which start dark when they get power."""

    def __init__(self, sinks: SinkSpec, guardian: Guardian, lease_s: float, pulse: Pulse | None = None) -> None:
        self._sinks = sinks
        super().__init__(sinks.device, dark_packets(sinks.chips), guardian, lease_s, pulse)

    def _lit(self, illumination: Illumination) -> bytes:
        return lit_packets(self._sinks, illumination)


class RingLightContext:
    """Context manager: the ring is on from entry to exit."""

    def __init__(self, ring: LedRing, illumination: Illumination) -> None:
        self._ring, self._illumination = ring, illumination

    def __enter__(self) -> "RingLightContext":
        """Turn the ring on; after an error turn it off again and raise the error."""
        try:
            self._ring.turn_on(self._illumination)
        except BaseException:
            self._ring.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Turn the ring off, also after an exception."""
        self._ring.off()
