"""Light from the ring to the pixel: how many electrons a human fundus gives, and how much light the eye gets for it.

optics.md 3.7 and 3.8. The LEDs' power is a guess until somebody measures it: within a factor of two (optics.md 10).
"""

from dataclasses import dataclass
from math import degrees, exp, log, pi, radians, sin, tan

from device.optics.eye import Relay
from device.values import Colour

PLANCK_LIGHT_J_M = 1.98645e-25  # h c
LEDS = 12
TO_THE_EYE = 0.42 * 0.5 * 0.9  # polariser, beam splitter, relay
FROM_THE_EYE = 0.9 * 0.5 * 0.40  # relay, beam splitter, crossed polariser of depolarised light
RELAY_HALF_CONE_DEG = 12.5
# Half-periods in simulation (optics.md 8.2): electrons at the peak of a pixel of 5.04 um, um on a retina behind 17 mm.
RESOLVED = ((2e3, 244.0), (20e3, 137.0), (100e3, 104.0))
RESOLVED_PITCH_UM, RESOLVED_EYE_MM = 5.04, 17.0


@dataclass(frozen=True)
class Led:
    """One colour of the ring: its wavelength, power of one LED at full drive, and what tissue and sensor make of it."""

    wavelength_um: float
    power_mw: float
    reflectance: float  # equivalent, mean of nasal fundus and perifovea: Delori & Pflibsen 1989, Table I
    quantum_efficiency: float


LED: dict[Colour, Led] = {
    "red": Led(0.622, 2.31, (0.072 + 0.049) / 2, 0.60),
    "green": Led(0.522, 1.98, (0.0194 + 0.0141) / 2, 0.58),
    "blue": Led(0.467, 4.89, (0.0129 + 0.0081) / 2, 0.445),
}


@dataclass(frozen=True)
class Budget:
    """What arrives on the way: at the cornea, on the retina, in the image, and as electrons in a pixel."""

    cornea_mw: float
    retina_mw_per_cm2: float
    image_nw: float
    electrons_per_px_s: float


def photon_budget(
    colour: Colour, pitch_um: float, field_deg: float = 33.4, eye_mm: float = 17.0, relay: Relay | None = None,
    leds: int = LEDS,
) -> Budget:  # fmt: skip
    """The light of all LEDs at full drive, spread over the field of a human eye and collected by its pupil's share.

    The image of a field is as wide as d + 2s, because the diffuser spreads every point over the iris's shadow.
    """
    relay, led = relay or Relay(), LED[colour]
    cornea_mw = leds * led.power_mw * sin(radians(RELAY_HALF_CONE_DEG)) ** 2 * TO_THE_EYE
    lit_cm2 = pi * (eye_mm / 10 * tan(radians(field_deg / 2))) ** 2
    retina_mw_per_cm2 = cornea_mw / lit_cm2
    radiance = retina_mw_per_cm2 * led.reflectance / pi
    pupil_cm2 = pi * (relay.iris_at_eye_mm / 20) ** 2
    image_nw = radiance * pupil_cm2 * lit_cm2 / (eye_mm / 10) ** 2 * FROM_THE_EYE * 1e6
    photons_per_s = image_nw * 1e-9 * led.wavelength_um * 1e-6 / PLANCK_LIGHT_J_M
    pixels = pi * (relay.extent_mm(field_deg) * 1000 / 2 / pitch_um) ** 2
    return Budget(cornea_mw, retina_mw_per_cm2, image_nw, photons_per_s * led.quantum_efficiency / pixels)


def half_period_deg(electrons_per_px: float, pitch_um: float) -> float:
    """The finest half-period that stands out of the photon noise: between three simulated points, by power laws.

    Outside of 2000 to 100000 electrons per 5.04 um pixel the nearest law goes on, which nobody has tried.
    """
    light = log(electrons_per_px * (RESOLVED_PITCH_UM / pitch_um) ** 2)
    known = [(log(electrons), log(um)) for electrons, um in RESOLVED]
    (x0, y0), (x1, y1) = known[:2] if light < known[1][0] else known[1:]
    um = exp(y0 + (light - x0) * (y1 - y0) / (x1 - x0))
    return degrees(um / 1000 / RESOLVED_EYE_MM)


def tried(electrons_per_px: float, pitch_um: float) -> bool:
    """Whether `half_period_deg` lies between points that were simulated."""
    light = electrons_per_px * (RESOLVED_PITCH_UM / pitch_um) ** 2
    return RESOLVED[0][0] <= light <= RESOLVED[-1][0]
