"""Hardware probe for technicians: checks every part of a head separately, so that one failure hides no other."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from device.clock import Clock
from device.config.head_file import ChainSpec, InstrumentSpec
from device.drivers.no_light import NoLight
from device.errors import HardwareError
from device.light_safety.dose_ledger import Ledger
from device.light_safety.guard import GuardedLight
from device.optics.matrix import chain_of, ring
from device.ports import Camera, Chips, Light
from device.values import BatteryState, Colour, ExposureSettings, Frame

MOSAIC_WARNING = "counts of three colours; a third of green light, and reconstruct needs --bayer"
DETECTION_SIGMAS = 6.0  # detection threshold of an LED above the dark frame's mean, in standard errors of that mean


@dataclass(frozen=True)
class ProbeFinding:
    """Result of one part's check: passed or not, the reading, and a remedy for a failure."""

    part: str
    ok: bool
    reading: str
    remedy: str = ""


class PartOpener(Protocol):
    """Opener of the parts of one head; each method raises a HardwareError if its part cannot be opened."""

    def light(self, ledger: Ledger, chain: ChainSpec | None = None) -> GuardedLight:
        """Return the guarded lamp, with the LEDs of `chain` instead of the head file's if given."""

    def camera(self, light: Light) -> Camera:
        """Return the camera, which marks its frames with the state of `light`."""

    def chips(self) -> Chips:
        """Return the chips that the head file names."""


OpenParts = Callable[[], AbstractContextManager[PartOpener]]


def probe_parts(
    spec: InstrumentSpec, open_parts: OpenParts, clock: Clock, ledger: Ledger, *, leds: bool = True
) -> Iterator[ProbeFinding]:
    """Check every part that the head file names, one after the other; light each LED of the ring and detect it.

    `open_parts` returns a context that closes the parts which were opened in it. The light is as bright as the guard
    permits, its dose counts in `ledger`, and as long a darkness follows it: each LED has a guard of its own. A
    HardwareError of a part becomes a finding and is not raised. The lamp is dark at the end, and without `leds` all the
    time. A colour mosaic is a finding that does not fail where the head file expects it; the driver refuses one that it
    does not expect.
    """
    with open_parts() as opening:
        light = camera = None
        try:
            light = opening.light(ledger)
            if spec.light.backend != "none":
                yield ProbeFinding("lamp", True, f"{spec.light.backend} answers")
        except HardwareError as error:
            yield _failure("lamp", error)
        try:
            camera = opening.camera(light or NoLight())
            reading = ", ".join([f"{camera.shape[1]} x {camera.shape[0]}", *camera.facts.values()])
            yield ProbeFinding("camera", True, reading)
        except HardwareError as error:
            yield _failure("camera", error)
        if camera is not None:
            yield _check_part("black level", lambda: _black_level(spec, camera))
        if camera is not None and "mosaic" in camera.facts:
            yield ProbeFinding("mosaic", True, f"colour filters {camera.facts['mosaic']}: {MOSAIC_WARNING}")
        if leds and camera is not None and light is not None and spec.light.backend != "none":
            yield from _leds(spec, open_parts, _LitCamera(camera, clock, spec.camera.preview_exposure_s), light, ledger)
        yield from _chips(opening)


@dataclass(frozen=True)
class _LitCamera:
    """Camera that measures a lamp: mean counts of a lit frame above those of a dark one."""

    camera: Camera
    clock: Clock
    exposure_s: float

    def finding(self, light: GuardedLight, colour: Colour) -> ProbeFinding:
        """Return the finding on a lamp: passed if the lit frame's mean is significantly above that of the dark frame.

        A lamp that is not seen is measured once more: on a busy computer its lease can end before the frame does.
        """
        first = self._measured(light, colour)
        return first if first.ok else self._measured(light, colour)

    def _measured(self, light: GuardedLight, colour: Colour) -> ProbeFinding:
        illumination = light.hazard.brightest(colour)
        shot = ExposureSettings(self.exposure_s)
        dark = self.camera.expose(shot).counts.astype(np.float64)
        begin_s = self.clock.now_s()
        with light.on(illumination):
            lit = float(self.camera.expose(shot).counts.mean(dtype=np.float64))
        self.clock.sleep(self.clock.now_s() - begin_s)  # as much darkness: no light is left to repay
        error = float(dark.std() / np.sqrt(dark.size))
        more = lit - float(dark.mean())
        if more > max(DETECTION_SIGMAS * error, 0.05):
            return ProbeFinding("ring", True, f"{more:.1f} counts above the dark, in {illumination.colour}")
        return ProbeFinding("ring", False, "lit, and not seen", "It may be dead, or covered. Call the technician.")


def _leds(
    spec: InstrumentSpec, open_parts: OpenParts, camera: _LitCamera, light: GuardedLight, ledger: Ledger
) -> Iterator[ProbeFinding]:
    """Yield one finding per LED of the ring; a lamp without separate LEDs is checked as a whole."""
    chain = chain_of(spec)
    colour = spec.light.preview_colour
    if chain is None:
        yield _check_part("ring", lambda: camera.finding(light, colour))
        return
    leds = ring(chain)
    for place, led in enumerate(leds):
        trims = None if chain.trims is None else (chain.trims[place],)
        alone = chain.model_copy(update={"leds": (led,), "trims": trims})

        def check_led(alone: ChainSpec = alone) -> ProbeFinding:
            with open_parts() as another:
                return camera.finding(another.light(ledger, alone), colour)

        yield _check_part(f"LED {led}", check_led)


def _black_level(spec: InstrumentSpec, camera: Camera) -> ProbeFinding:
    """Return the finding on the black level: a dark frame's median matches the head file within 10 % or 4 DN."""
    frame: Frame = camera.expose(ExposureSettings(spec.camera.preview_exposure_s))
    found = float(np.median(frame.counts))
    ok = abs(found - spec.camera.black_dn) <= max(4.0, 0.1 * spec.camera.black_dn)
    reading = f"{found:.0f} counts in the dark, the head file says {spec.camera.black_dn:.0f}"
    return ProbeFinding("black level", ok, reading, "" if ok else "Light leaks in, or this is another sensor mode.")


def _chips(opening: PartOpener) -> Iterator[ProbeFinding]:
    """Yield one finding for each chip on the I2C bus, or one for the bus if it cannot be opened."""
    try:
        chips = opening.chips()
    except HardwareError as error:
        yield _failure("I2C bus", error)
        return
    if (thermometer := chips.thermometer) is not None:
        yield _check_part("thermometer", lambda: ProbeFinding("", True, f"{thermometer.read_c():.1f} C"))
    if (battery := chips.battery) is not None:
        yield _check_part("battery", lambda: _charge_finding(battery.read()))
    if (memory := chips.memory) is not None:
        yield _check_part("head's memory", lambda: ProbeFinding("", True, str(memory.read() or "empty")))


def _charge_finding(charge: BatteryState) -> ProbeFinding:
    """Return the passed finding that states the battery's charge and voltage."""
    return ProbeFinding("battery", True, f"{charge.fraction:.0%}, {charge.volts:.2f} V")


def _check_part(part: str, ask: Callable[[], ProbeFinding]) -> ProbeFinding:
    """Return the finding of a check under the part's name; a HardwareError becomes a failed finding."""
    try:
        return replace(ask(), part=part)
    except HardwareError as error:
        return _failure(part, error)


def _failure(part: str, error: HardwareError) -> ProbeFinding:
    """Return the failed finding of a part, with message and remedy of the error."""
    return ProbeFinding(part, False, error.message, error.remedy)
