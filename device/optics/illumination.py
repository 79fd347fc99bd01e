"""Photon budget from the LED ring to the pixel: irradiance at the eye, and electrons from a human fundus.

OPTICS.md 4.1 and 4.2. The LEDs' power is an estimate within a factor of two until it is measured (OPTICS.md 5.2).
"""

from dataclasses import dataclass
from math import degrees, exp, inf, log, pi, radians, sin, tan

import numpy as np

from device.optics import field_extent
from device.optics.eye import Relay
from device.values import Colour

PLANCK_LIGHT_J_M = 1.98645e-25  # h c
LEDS = 12
TRANSMISSION_TO_EYE = 0.42 * 0.5 * 0.9  # transmission of polariser, beam splitter, relay
TRANSMISSION_FROM_EYE = 0.9 * 0.5 * 0.40  # transmission of relay, beam splitter, crossed polariser of depolarised light
RELAY_HALF_CONE_DEG, RELAY_FIELD_DEG, RELAY_MAGNIFICATION = 12.5, 33.4, 0.75  # of the paper's LED cap, and its field
MEAN_OVER_PEAK = 0.30  # of a frame: mean of the disc d + 2 s over its brightest pixel (OPTICS.md 4.7)
# Half-periods in simulation (OPTICS.md 4.3): electrons at the peak of a pixel of 5.04 um, um on a retina behind 17 mm.
RESOLVED = ((2e3, 244.0), (20e3, 137.0), (100e3, 104.0))
RESOLVED_PITCH_UM, RESOLVED_EYE_MM = 5.04, 17.0


@dataclass(frozen=True)
class Led:
    """One colour of the ring: wavelength, power of one LED at full drive, reflectance of tissue, quantum efficiency."""

    wavelength_um: float
    power_mw: float
    reflectance: float  # equivalent, mean of nasal fundus and perifovea: Delori & Pflibsen 1989, Table I
    quantum_efficiency: float


LED: dict[Colour, Led] = {
    "red": Led(0.622, 2.31, (0.072 + 0.049) / 2, 0.60),
    "green": Led(0.522, 1.98, (0.0194 + 0.0141) / 2, 0.58),
    "blue": Led(0.467, 4.89, (0.0129 + 0.0081) / 2, 0.445),
}  # of an APA102-2020
PEAK_UM: dict[Colour, float] = {colour: led.wavelength_um for colour, led in LED.items()} | {"amber": 0.590}
# Wavelength, um, with the reflectance and the quantum efficiency there; at 590 nm both are estimates (OPTICS.md 4.1).
RESPONSE = (
    (0.467, LED["blue"].reflectance, 0.445),
    (0.522, LED["green"].reflectance, 0.58),
    (0.590, 0.030, 0.61),
    (0.622, LED["red"].reflectance, 0.60),
)


def led_at(wavelength_um: float, power_mw: float) -> Led:
    """Return an LED of that peak and power; reflectance and efficiency by power laws between the points of RESPONSE.

    Outside of 0.467 to 0.622 um the value of the nearest point is taken.
    """
    um, reflectance, efficiency = zip(*RESPONSE, strict=True)
    at = np.log(wavelength_um)
    values = (float(np.exp(np.interp(at, np.log(um), np.log(known)))) for known in (reflectance, efficiency))
    return Led(wavelength_um, power_mw, *values)


@dataclass(frozen=True)
class PhotonBudget:
    """Photon budget: power at the cornea and in the image, irradiance on the retina, electrons per pixel per second."""

    cornea_mw: float
    retina_mw_per_cm2: float
    image_nw: float
    electrons_per_px_s: float


def half_cone_deg(field_deg: float, magnification: float = RELAY_MAGNIFICATION) -> float:
    """Return the half cone of an LED that lights a full field, both in degrees; `magnification` is f1 / f2."""
    return RELAY_HALF_CONE_DEG * (field_deg * magnification) / (RELAY_FIELD_DEG * RELAY_MAGNIFICATION)


def photon_budget(
    colour: Colour,
    pitch_um: float,
    field_deg: float = 33.4,
    eye_mm: float = 17.0,
    relay: Relay | None = None,
    leds: int = LEDS,
    led: Led | None = None,
    half_cone: float | None = None,
) -> PhotonBudget:
    """Return the budget of `leds` LEDs at full drive, spread over the field of a human eye, collected by the iris.

    `eye_mm` is the eye's focal length; `relay` None: the paper's; `led` None: that colour of an APA102-2020;
    `half_cone` None: the cone that lights the field, degrees. The image's width is d + 2 s, iris plus twice the shift
    of the field's edge, because the diffuser spreads every point over the iris's shadow.
    """
    relay = relay or Relay()
    led = led or LED[colour]
    half_cone = half_cone or half_cone_deg(field_deg, relay.angular_magnification)
    cornea_mw = leds * led.power_mw * sin(radians(half_cone)) ** 2 * TRANSMISSION_TO_EYE
    lit_cm2 = pi * (eye_mm / 10 * tan(radians(field_deg / 2))) ** 2
    retina_mw_per_cm2 = cornea_mw / lit_cm2
    radiance = retina_mw_per_cm2 * led.reflectance / pi
    pupil_cm2 = pi * (relay.iris_at_eye_mm / 20) ** 2
    image_nw = radiance * pupil_cm2 * lit_cm2 / (eye_mm / 10) ** 2 * TRANSMISSION_FROM_EYE * 1e6
    photons_per_s = image_nw * 1e-9 * led.wavelength_um * 1e-6 / PLANCK_LIGHT_J_M
    pixels = pi * (field_extent.extent_mm(relay, field_deg) * 1000 / 2 / pitch_um) ** 2
    return PhotonBudget(cornea_mw, retina_mw_per_cm2, image_nw, photons_per_s * led.quantum_efficiency / pixels)


def half_period_deg(peak_e: float, pitch_um: float) -> float:
    """Return the finest resolved half-period, degrees at the eye, for this light: power laws through simulated points.

    `peak_e`: electrons of the brightest pixel, which is the mean of the lit disc over MEAN_OVER_PEAK; infinite without
    light. Outside of 2000 to 100000 electrons per 5.04 um pixel the nearest law is extrapolated; no simulation supports
    that.
    """
    if peak_e <= 0:
        return inf
    light = log(peak_e * (RESOLVED_PITCH_UM / pitch_um) ** 2)
    known = [(log(electrons), log(um)) for electrons, um in RESOLVED]
    (x0, y0), (x1, y1) = known[:2] if light < known[1][0] else known[1:]
    um = exp(y0 + (light - x0) * (y1 - y0) / (x1 - x0))
    return degrees(um / 1000 / RESOLVED_EYE_MM)


def within_simulated_range(peak_e: float, pitch_um: float) -> bool:
    """Return true if `half_period_deg` interpolates between simulated points."""
    light = peak_e * (RESOLVED_PITCH_UM / pitch_um) ** 2
    return RESOLVED[0][0] <= light <= RESOLVED[-1][0]
