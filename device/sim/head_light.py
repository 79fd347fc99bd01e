"""Light of a scene with `peak_e = "budget"`: electrons that a human eye gives with the head's own LEDs.

The mean over the lit disc on the sensor (of diameter d + 2 s) is the product of the light budget's factors, with the
scene's eye (OPTICS.md 4.6 and 4.7).
"""

from dataclasses import replace
from functools import cache
from math import pi
from typing import NamedTuple

from device.config.head_file import InstrumentSpec
from device.config.shipped_heads import LIGHT_PATH
from device.errors import SpecError
from device.optics import field_extent
from device.optics.budget import Design, design_of_head
from device.optics.illumination import LED
from device.optics.light_budget import CELL_UM, chain, product
from device.optics.light_path import LightPath, load_light_path
from device.optics.matrix import lamps_of, ring
from device.values import Colour


class HeadLight(NamedTuple):
    """Mean electrons of a pixel of the lit disc in one exposure at full drive, the disc's pixels, and the origin."""

    mean_e: float
    disc_px: float
    why: str


def head_light(spec: InstrumentSpec, colour: Colour) -> HeadLight:
    """Return the light of the scene's human eye in one colour by the budget of the head's LEDs.

    A measured irradiance of the retina ([light.radiometry]) replaces the estimated one. SpecError for a head without
    lamp, without LEDs of that colour, or without the tables [optics] and [sim].
    """
    design = _design(spec, colour)
    mean_e = product(chain(design)) * (design.pitch_um / CELL_UM) ** 2
    leds = f"{len(ring(design.chain))} {colour} LEDs of {design.led.power_mw:g} mW"
    origin = f"{leds}, not measured: 90 % of heads and eyes within a factor of 2.5"
    beam = design.measured
    if design.radiometry is not None and beam is not None:
        origin = f"{beam.retina_mw_per_cm2:g} mW/cm2 on the retina, measured: {design.radiometry.measured}"
    diameter_px = 1000 * field_extent.extent_mm(design.relay, design.optics.field_deg) / design.pitch_um
    return HeadLight(mean_e, pi * diameter_px**2 / 4, f"the budget's mean is {mean_e:.0f}: {origin}")


def _design(spec: InstrumentSpec, colour: Colour) -> Design:
    """Return the design of a head with the scene's eye, in one colour of its light."""
    if spec.light.backend in ("none", "replay"):
        raise SpecError(
            f'{spec.name}: peak_e = "budget", but this head has no lamp',
            "Name a head with LEDs under [light], or give [sim] peak_e as a number of electrons.",
        )
    if colour not in (lamps_of(spec) or LED):
        raise SpecError(
            f'{spec.name}: peak_e = "budget", but this head has no {colour} LEDs',
            "Choose a colour of the head's LEDs, or give [sim] peak_e as a number of electrons.",
        )
    lit = spec.model_copy(update={"light": spec.light.model_copy(update={"colour": colour})})
    design = design_of_head(_light_path(), lit)
    if spec.sim is None:
        raise SpecError(f"{spec.name}: a simulated head needs the tables [optics] and [sim]")
    eye = spec.sim.eye
    return replace(design, eye_mm=eye.focal_length_um / 1000, pupil_mm=eye.pupil_um / 1000)


@cache
def _light_path() -> LightPath:
    return load_light_path(LIGHT_PATH)
