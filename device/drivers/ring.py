"""The LED ring: an APA102 chain behind the real spidev, dark unless a context holds it on.

The chain keeps its last colour when the bus falls silent, so darkness is always said, and said twice.
"""

from collections.abc import Collection
from threading import Lock
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from device.drivers.blank import SPEED_HZ, blank_frame
from device.drivers.guardian import Guardian
from device.drivers.wire import current_ma, encoded, levels
from device.errors import LightFault, LightLimit, SpecError
from device.optics.ring import ring, ring_for_pupil_mm
from device.spec import LightSpec
from device.values import Colour, Glow

_CHANNELS: tuple[Colour, ...] = ("red", "green", "blue")
_NO_BUS = "The lamp's bus is missing. Check `dtparam=spi=on` in config.txt, the cable, and spi_device in the head file."


class Pulse(Protocol):
    """What shows the outside world that a lease is live (device/drivers/heartbeat.py)."""

    def start(self, lease_s: float) -> None:
        """Beat from now, at most for `lease_s` seconds."""

    def stop(self) -> None:
        """Be still."""


def chosen_leds(spec: LightSpec) -> tuple[int, ...]:
    """The LEDs that a head's ring is made of; SpecError if its board has no such ring."""
    board = (spec.pitch_mm, spec.axis, spec.rows, spec.cols)
    diameter_mm = spec.ring_mm
    if spec.pupil_mm is not None:
        diameter_mm = ring_for_pupil_mm(spec.pupil_mm, spec.relay_magnification, spec.led_mm, *board)
    return ring(diameter_mm, spec.ring_tolerance_mm, *board)


class Apa102Ring:
    """A Light that is a ring of LEDs; every lease of light is known to its guardian before the first photon.

    Raises LightFault if the bus is missing, fails or cuts a frame short, and LightLimit beyond the current's cap.
    """

    def __init__(self, spec: LightSpec, guardian: Guardian, pulse: Pulse | None = None) -> None:
        import spidev

        self.spec, self.leds = spec, chosen_leds(spec)
        self._output = np.array(spec.led_output or [1.0] * spec.leds)
        self.guardian, self._pulse = guardian, pulse
        self._blank = blank_frame(spec.leds)
        self._glow: Glow | None = None
        self._turn = Lock()  # the guard's timer darkens from a thread of its own
        self._open = True
        self._wire = spidev.SpiDev()
        try:
            self._wire.open_path(spec.spi_device)
            self._wire.mode = 0
            self._wire.max_speed_hz = SPEED_HZ
        except OSError as error:
            raise LightFault(f"{spec.spi_device} does not open: {error}", _NO_BUS) from error
        self.off()

    @property
    def glow(self) -> Glow | None:
        """What it shines now; None when it is dark, also if the guardian made it so."""
        if self._glow is not None and self.guardian.notice():
            self._glow = None
        return self._glow

    def on(self, glow: Glow, leds: Collection[int] | None = None) -> "RingLit":
        """Shine from the entry of the returned context to its end, the head's ring or the LEDs of one's choice.

        Raises LightLimit if that would draw too much current; on entry LightFault, and is then dark.
        """
        return RingLit(self, glow, self.colours(glow, leds))

    def colours(self, glow: Glow, leds: Collection[int] | None = None) -> NDArray[np.uint8]:
        """(leds, 3) drive values of red, green, blue for a glow, evened out by what each LED gives."""
        numbers = np.array(sorted(self.leds if leds is None else leds), int)
        if not len(numbers) or numbers[0] < 0 or numbers[-1] >= self.spec.leds:
            raise SpecError(f"LEDs {numbers.tolist()} are not all among the {self.spec.leds} of this board")
        rgb = np.zeros((self.spec.leds, 3), np.uint8)
        rgb[numbers, _CHANNELS.index(glow.colour)] = levels(glow.level, self._output[numbers])
        if (asked_ma := current_ma(rgb)) > self.spec.max_current_ma:
            raise LightLimit(
                f"{len(numbers)} LEDs would draw {asked_ma:.0f} mA; the head allows {self.spec.max_current_ma:g} mA",
                "Choose fewer LEDs or a lower level.",
            )
        return rgb

    def shine(self, glow: Glow, rgb: NDArray[np.uint8]) -> None:
        """Shine now; for the context only."""
        with self._turn:
            if not self._open:
                raise LightFault("the ring has been closed")
            self.guardian.lit(self.spec.max_on_s)
            if self._pulse is not None:
                self._pulse.start(self.spec.max_on_s)
            try:
                self._send(encoded(rgb))
                self._glow = glow
            except BaseException:
                self._darken()
                raise

    def off(self) -> None:
        """Be dark; always allowed, harmless when it is dark already. LightFault if the bus does not take it."""
        with self._turn:
            if self._open:
                self._darken()

    def close(self) -> None:
        """Be dark and let the bus and the guardian go; closing twice is harmless."""
        with self._turn:
            if not self._open:
                return
            try:
                self._darken()
            finally:
                self._open = False
                self._wire.close()
                self.guardian.close()  # darkens once more

    def _darken(self) -> None:
        """Say darkness twice. Until the bus has taken it, the guardian's lease goes on."""
        if self._pulse is not None:
            self._pulse.stop()
        self._send(self._blank)
        self._send(self._blank)
        self._glow = None
        self.guardian.dark()

    def _send(self, frame: bytes) -> None:
        try:
            self._wire.writebytes2(frame)
        except OSError as error:
            raise LightFault(f"{self.spec.spi_device} does not take the colours: {error}") from error
        except SystemError as error:  # spidev's way of saying that the kernel took only a part
            raise LightFault(f"{self.spec.spi_device} cut the colours short") from error


class RingLit:
    """The time in which the ring shines."""

    def __init__(self, light: Apa102Ring, glow: Glow, rgb: NDArray[np.uint8]) -> None:
        self._light, self._glow, self._rgb = light, glow, rgb

    def __enter__(self) -> "RingLit":
        """The ring is on."""
        self._light.shine(self._glow, self._rgb)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The ring is dark, whatever happened."""
        self._light.off()
