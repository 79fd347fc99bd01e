"""What light does to a retina: weighted irradiances and doses, against the limits of `light_limits.toml`."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import exp, floor, log, pi
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from device.errors import LightLimit, SpecError
from device.optics.illumination import LED, LEDS, TO_THE_EYE, photon_budget
from device.radiometry import RadiometrySpec
from device.tables import Table, load_toml
from device.values import Colour, Glow

LIMITS = Path(__file__).with_name("light_limits.toml")
LED_GUESS = 2.0  # the LEDs' power is known within this factor (device/optics/illumination.py)
WAIST_CM2 = pi * 0.05**2  # a disc of 1 mm
FIELD_DEG = 33.4  # the paper's; where a head does not say


class _Source(Table):
    """Where a number stands, and whether somebody has compared it with the purchased text."""

    edition: str = Field(min_length=1)
    clause: str = Field(min_length=1)
    checked: bool


class _Rate(_Source):
    limit: float = Field(gt=0)
    share: float = Field(gt=0, le=1)


class _Micro(_Rate):
    unit: Literal["uW/cm2"]


class _Watts(_Rate):
    unit: Literal["W/cm2"]


class _Dose(_Rate):
    unit: Literal["J/cm2"]
    warn_share: float = Field(gt=0, le=1)
    window_h: float = Field(ge=24)


class Weight(_Source):
    """A weight by wavelength, interpolated in its logarithm."""

    nm: tuple[float, ...] = Field(min_length=2)
    weight: tuple[float, ...]

    @model_validator(mode="after")
    def _is_a_function(self) -> "Weight":
        if len(self.nm) != len(self.weight) or any(b <= a for a, b in pairwise(self.nm)) or min(self.weight) <= 0:
            raise ValueError("nm must rise, and every nm have a weight above 0")
        return self

    def at(self, wavelength_um: float) -> float:
        """The weight of one wavelength; SpecError outside the table."""
        nm = round(1000 * wavelength_um, 6)
        for (low, at_low), (high, at_high) in pairwise(zip(self.nm, self.weight, strict=True)):
            if low <= nm <= high:
                return exp(log(at_low) + (log(at_high) - log(at_low)) * (nm - low) / (high - low))
        raise SpecError(f"light of {nm:g} nm has no weight between {self.nm[0]:g} and {self.nm[-1]:g} nm")


class Limits(Table):
    """The limits of `light_limits.toml`; the properties are what this instrument uses of them, in W and J per cm2."""

    photochemical_irradiance: _Micro
    photochemical_dose: _Dose
    thermal_irradiance: _Watts
    waist_irradiance: _Watts
    photochemical_weight: Weight
    thermal_weight: Weight

    @property
    def photochemical_w_per_cm2(self) -> float:
        """Most A-weighted irradiance of a retina."""
        return self.photochemical_irradiance.limit * self.photochemical_irradiance.share * 1e-6

    @property
    def thermal_w_per_cm2(self) -> float:
        """Most R-weighted irradiance of a retina."""
        return self.thermal_irradiance.limit * self.thermal_irradiance.share

    @property
    def waist_w_per_cm2(self) -> float:
        """Most irradiance in the waist of the beam."""
        return self.waist_irradiance.limit * self.waist_irradiance.share

    @property
    def stop_j_per_cm2(self) -> float:
        """The A-weighted dose that no eye gets more of in `window_s`."""
        return self.photochemical_dose.limit * self.photochemical_dose.share

    @property
    def warn_j_per_cm2(self) -> float:
        """The dose from which on a picture's report warns."""
        return self.photochemical_dose.limit * self.photochemical_dose.warn_share

    @property
    def window_s(self) -> float:
        """How long a dose counts."""
        return self.photochemical_dose.window_h * 3600


def light_limits(path: Path = LIMITS) -> Limits:
    """The reviewed limits; SpecError if the file is missing or damaged: there is no default."""
    return load_toml(path, Limits)


@dataclass(frozen=True)
class Beam:
    """One colour of the ring at full drive, at the eye; guard factors are in it already."""

    wavelength_um: float
    retina_w_per_cm2: float
    waist_w_per_cm2: float


Radiometry = Mapping[Colour, Beam]
NO_LIGHT: Radiometry = {colour: Beam(led.wavelength_um, 0.0, 0.0) for colour, led in LED.items()}  # of a recording


def radiometry(measured: RadiometrySpec | None = None, field_deg: float = FIELD_DEG, leds: int = LEDS) -> Radiometry:
    """What a head measured, times its guard factor; a colour that was not measured is taken at its worst."""
    found: dict[Colour, Beam] = {}
    for colour in LED:
        spec = measured.beam(colour) if measured else None
        if measured is None or spec is None:
            found[colour] = worst_beam(colour, field_deg, leds)
        else:
            scale = measured.guard_factor / 1000
            found[colour] = Beam(spec.wavelength_um, scale * spec.retina_mw_per_cm2, scale * spec.waist_mw_per_cm2)
    return found


def worst_beam(colour: Colour, field_deg: float = FIELD_DEG, leds: int = LEDS) -> Beam:
    """A colour that nobody measured: no optics takes any light, and the LEDs are as bright as the guess may be wrong.

    The LEDs are further apart than the waist's disc, so that the brightest disc holds the light of one.
    """
    budget = photon_budget(colour, pitch_um=1.0, field_deg=field_deg)
    scale = LED_GUESS / TO_THE_EYE / 1000
    return Beam(
        LED[colour].wavelength_um,
        scale * budget.retina_mw_per_cm2 * leds / LEDS,
        scale * budget.cornea_mw / LEDS / WAIST_CM2,
    )


@dataclass(frozen=True)
class Hazard:
    """What a glow of this head does to an eye, and whether it may."""

    beams: Radiometry
    limits: Limits

    def photochemical_w_per_cm2(self, glow: Glow) -> float:
        """The A-weighted irradiance of the retina."""
        beam = self.beams[glow.colour]
        return glow.level * beam.retina_w_per_cm2 * self.limits.photochemical_weight.at(beam.wavelength_um)

    def thermal_w_per_cm2(self, glow: Glow) -> float:
        """The R-weighted irradiance of the retina."""
        beam = self.beams[glow.colour]
        return glow.level * beam.retina_w_per_cm2 * self.limits.thermal_weight.at(beam.wavelength_um)

    def waist_w_per_cm2(self, glow: Glow) -> float:
        """The irradiance in the waist of the beam."""
        return glow.level * self.beams[glow.colour].waist_w_per_cm2

    def dose_j_per_cm2(self, glow: Glow, duration_s: float) -> float:
        """The A-weighted dose of a retina that sees a glow for so long."""
        return self.photochemical_w_per_cm2(glow) * max(0.0, duration_s)

    def refuse(self, glow: Glow) -> None:
        """LightLimit, with the level that is allowed, if a glow is brighter than any of the three limits."""
        limits = self.limits
        times = max(
            self.photochemical_w_per_cm2(glow) / limits.photochemical_w_per_cm2,
            self.thermal_w_per_cm2(glow) / limits.thermal_w_per_cm2,
            self.waist_w_per_cm2(glow) / limits.waist_w_per_cm2,
        )
        if times > 1:
            raise LightLimit(
                f"{glow.colour} light at {100 * glow.level:.3g} % is {times:.3g} times brighter than an eye may see",
                f"Dim it to {floor(1000 * glow.level / times) / 10:g} % or less, or have the head's light measured.",
            )
