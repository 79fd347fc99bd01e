"""What is there: every part of a head asked by itself, so that one that is missing hides no other. For technicians."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from device.clock import Clock
from device.errors import HardwareError
from device.head import Opening
from device.optics.matrix import chain_of, ring
from device.ports import Camera, Light
from device.spec import ChainSpec, InstrumentSpec
from device.values import Charge, Frame, Glow, Shot

SEEN_SIGMAS = 6.0  # above the dark frame's mean, in standard errors of it, before an LED counts as seen


@dataclass(frozen=True)
class Finding:
    """One part: whether it is well, what it said, and what to do if it is not."""

    part: str
    ok: bool
    said: str
    remedy: str = ""


def probe(spec: InstrumentSpec, clock: Clock, allocator: Any = None) -> Iterator[Finding]:
    """Ask every part that the head file names, one after the other; each LED of the ring is lit, and looked for.

    Nothing is raised for a part that fails: it is told. The lamp is dark at the end.
    """
    with Opening(spec, clock, allocator) as opening:
        light = camera = None
        try:
            light = opening.lamp()
            yield Finding("lamp", True, f"{spec.light.backend} answers")
        except HardwareError as error:
            yield _failed("lamp", error)
        try:
            camera = opening.camera(light or _Unlit())
            facts = getattr(camera, "facts", {})
            yield Finding("camera", True, ", ".join([f"{camera.shape[1]} x {camera.shape[0]}", *facts.values()]))
        except HardwareError as error:
            yield _failed("camera", error)
        if camera is not None:
            yield _asked("black level", lambda: _black(spec, camera))
        if camera is not None and light is not None:
            yield from _leds(opening, camera, light)
        yield from _chips(opening)


def _leds(opening: Opening, camera: Camera, light: Light) -> Iterator[Finding]:
    """Each LED of the ring by itself; a lamp that cannot be taken apart is lit as a whole."""
    spec = opening.spec
    colour, shot = Glow(spec.light.preview_colour), Shot(spec.camera.preview_exposure_s)
    chain = chain_of(spec)
    if chain is None:
        yield _asked("ring", lambda: _seen(camera, light, colour, shot))
        return
    for led in ring(chain):
        alone = chain.model_copy(update={"leds": (led,), "trims": None})

        def look(alone: ChainSpec = alone) -> Finding:
            with Opening(spec, opening.clock) as another:
                return _seen(camera, another.lamp(alone), colour, shot)

        yield _asked(f"LED {led}", look)


def _seen(camera: Camera, light: Light, glow: Glow, shot: Shot) -> Finding:
    """Whether the camera sees the lamp: the mean of a lit frame against that of a dark one."""
    dark = camera.expose(shot).counts.astype(np.float64)
    with light.on(glow):
        lit = float(camera.expose(shot).counts.mean(dtype=np.float64))
    error = float(dark.std() / np.sqrt(dark.size))
    more = lit - float(dark.mean())
    if more > max(SEEN_SIGMAS * error, 0.05):
        return Finding("ring", True, f"{more:.1f} counts above the dark, in {glow.colour}")
    return Finding("ring", False, "lit, and not seen", "It may be dead, or covered. Call the technician.")


def _black(spec: InstrumentSpec, camera: Camera) -> Finding:
    frame: Frame = camera.expose(Shot(spec.camera.preview_exposure_s))
    found = float(np.median(frame.counts))
    ok = abs(found - spec.camera.black_dn) <= max(4.0, 0.1 * spec.camera.black_dn)
    said = f"{found:.0f} counts in the dark, the head file says {spec.camera.black_dn:.0f}"
    return Finding("black level", ok, said, "" if ok else "Light leaks in, or this is another sensor mode.")


def _chips(opening: Opening) -> Iterator[Finding]:
    try:
        chips = opening.chips()
    except HardwareError as error:
        yield _failed("I2C bus", error)
        return
    if (thermometer := chips.thermometer) is not None:
        yield _asked("thermometer", lambda: Finding("", True, f"{thermometer.read_c():.1f} C"))
    if (battery := chips.battery) is not None:
        yield _asked("battery", lambda: _charge(battery.read()))
    if (memory := chips.memory) is not None:
        yield _asked("head's memory", lambda: Finding("", True, str(memory.read() or "empty")))


def _charge(charge: Charge) -> Finding:
    return Finding("battery", True, f"{charge.fraction:.0%}, {charge.volts:.2f} V")


def _asked(part: str, ask: Callable[[], Finding]) -> Finding:
    try:
        return replace(ask(), part=part)
    except HardwareError as error:
        return _failed(part, error)


def _failed(part: str, error: HardwareError) -> Finding:
    return Finding(part, False, error.message, error.remedy)


class _Unlit:
    """No lamp: frames say that it was dark."""

    @property
    def glow(self) -> Glow | None:
        """Nothing."""
        return None

    def on(self, glow: Glow) -> Any:
        """Nothing can shine."""
        raise NotImplementedError(glow)

    def off(self) -> None:
        """It is dark."""
