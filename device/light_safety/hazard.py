"""Retinal light hazard: weighted irradiances and doses, against the limits of `limits.toml` (ISO 15004-2)."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import exp, floor, log, sqrt
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from device.config.radiometry import FIELD_DEG, WAIST_CM2, RadiometrySpec
from device.config.toml_file import Table, load_toml
from device.errors import LightLimit, SpecError
from device.optics.illumination import (
    LED,
    LEDS,
    RELAY_HALF_CONE_DEG,
    RELAY_MAGNIFICATION,
    TRANSMISSION_TO_EYE,
    Led,
    half_cone_deg,
    photon_budget,
)
from device.optics.matrix import Lamp
from device.values import Colour, Illumination

LIMITS = Path(__file__).with_name("limits.toml")
MAX_UNCHECKED_SHARE = 0.5  # of a limit that was not compared with the purchased standard
LEVELS = 1000  # steps of the level: a colour that is too bright at the lowest one has no permitted level
LED_POWER_UNCERTAINTY = 2.0  # uncertainty factor of the LEDs' power (device/optics/illumination.py)


class _Source(Table):
    """Source of a number: edition, clause and formula of the standard.

    `checked`: compared with the purchased standard, by `checked_by`, against the copy `checked_against`.
    """

    edition: str = Field(min_length=1)
    clause: str = Field(min_length=1)
    formula: str = Field(min_length=1)
    checked: bool
    checked_by: str = ""
    checked_against: str = ""

    @model_validator(mode="after")
    def _names_who_checked(self) -> Self:
        named = (bool(self.checked_by), bool(self.checked_against))
        if named != (self.checked, self.checked):
            raise ValueError("checked needs checked_by and checked_against, and they need checked")
        return self


class _Rate(_Source):
    limit: float = Field(gt=0)
    share: float = Field(gt=0, le=1)

    @model_validator(mode="after")
    def _uses_half_of_what_is_unchecked(self) -> Self:
        if not self.checked and self.share > MAX_UNCHECKED_SHARE:
            raise ValueError(f"the share of an unchecked limit is at most {MAX_UNCHECKED_SHARE}")
        return self


class _Micro(_Rate):
    unit: Literal["uW/cm2"]


class _Watts(_Rate):
    unit: Literal["W/cm2"]


class _Dose(_Rate):
    unit: Literal["J/cm2"]
    share_without_visit: float = Field(gt=0, le=1)
    warn_share: float = Field(gt=0, le=1)
    window_h: float = Field(ge=24)

    @model_validator(mode="after")
    def _leaves_a_visit_its_dose(self) -> "_Dose":
        if self.share_without_visit >= self.share:
            raise ValueError("share_without_visit must be below share")
        return self


class Weight(_Source):
    """Spectral weight over wavelength (`nm`, ascending), interpolated linearly in the logarithm of the weight."""

    nm: tuple[float, ...] = Field(min_length=2)
    weight: tuple[float, ...]

    @model_validator(mode="after")
    def _is_a_function(self) -> "Weight":
        if len(self.nm) != len(self.weight) or any(b <= a for a, b in pairwise(self.nm)) or min(self.weight) <= 0:
            raise ValueError("nm must rise, and every nm have a weight above 0")
        return self

    def at(self, wavelength_um: float) -> float:
        """Return the weight at a wavelength, um; SpecError outside the table."""
        nm = round(1000 * wavelength_um, 6)
        for (low, at_low), (high, at_high) in pairwise(zip(self.nm, self.weight, strict=True)):
            if low <= nm <= high:
                return exp(log(at_low) + (log(at_high) - log(at_low)) * (nm - low) / (high - low))
        raise SpecError(f"light of {nm:g} nm has no weight between {self.nm[0]:g} and {self.nm[-1]:g} nm")

    def of_spectrum(self, wavelength_um: float, fwhm_um: float) -> float:
        """Return the mean weight of a Gaussian spectrum by its peak and full width, um; width 0: of the peak.

        An LED of 525 nm and 35 nm weighs 1.26 times its peak, as A(lambda) is exponential. What lies outside the table
        counts nothing.
        """
        if fwhm_um == 0:
            return self.at(wavelength_um)
        sigma_um = fwhm_um / sqrt(8 * log(2))
        places = (wavelength_um + 0.1 * step * sigma_um for step in range(-40, 41))
        inside = [um for um in places if self.nm[0] <= round(1000 * um, 6) <= self.nm[-1]]
        shares = [exp(-(((um - wavelength_um) / sigma_um) ** 2) / 2) for um in inside]
        return sum(share * self.at(um) for share, um in zip(shares, inside, strict=True)) / sum(shares)


class Limits(Table):
    """Limits of `limits.toml`; the properties are this instrument's limits: standard value times permitted share."""

    photochemical_irradiance: _Micro
    photochemical_dose: _Dose
    thermal_irradiance: _Watts
    waist_irradiance: _Watts
    photochemical_weight: Weight
    thermal_weight: Weight

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Return the names of the limits and weights that were not compared with the purchased standard."""
        sources = {name: getattr(self, name) for name in type(self).model_fields}
        return tuple(name for name, source in sources.items() if not source.checked)

    @property
    def photochemical_w_per_cm2(self) -> float:
        """Return the limit of the A-weighted retinal irradiance, W/cm2."""
        return self.photochemical_irradiance.limit * self.photochemical_irradiance.share * 1e-6

    @property
    def thermal_w_per_cm2(self) -> float:
        """Return the limit of the R-weighted retinal irradiance, W/cm2."""
        return self.thermal_irradiance.limit * self.thermal_irradiance.share

    @property
    def waist_w_per_cm2(self) -> float:
        """Return the limit of the irradiance in the waist of the beam, W/cm2."""
        return self.waist_irradiance.limit * self.waist_irradiance.share

    @property
    def stop_j_per_cm2(self) -> float:
        """Return the largest permitted A-weighted retinal dose of an eye within `window_s`, J/cm2."""
        return self.photochemical_dose.limit * self.photochemical_dose.share

    @property
    def stop_without_visit_j_per_cm2(self) -> float:
        """Return the dose of an eye within `window_s`, J/cm2, that light without a visit may not exceed."""
        return self.photochemical_dose.limit * self.photochemical_dose.share_without_visit

    @property
    def warn_j_per_cm2(self) -> float:
        """Return the dose of an eye within `window_s` above which a picture's report warns, J/cm2."""
        return self.photochemical_dose.limit * self.photochemical_dose.warn_share

    @property
    def window_s(self) -> float:
        """Return how long a dose counts, s (at least 24 h)."""
        return self.photochemical_dose.window_h * 3600


def light_limits(path: Path = LIMITS) -> Limits:
    """Return the limits in `limits.toml`; SpecError if the file is missing or damaged: there is no default."""
    return load_toml(path, Limits)


@dataclass(frozen=True)
class Beam:
    """Unweighted irradiances at the eye from the ring at full drive in one colour; guard factors are included.

    `fwhm_um`: width of the spectrum about its peak `wavelength_um`.
    """

    wavelength_um: float
    retina_w_per_cm2: float
    waist_w_per_cm2: float
    fwhm_um: float = 0.0


Radiometry = Mapping[Colour, Beam]
NO_LIGHT: Radiometry = {colour: Beam(led.wavelength_um, 0.0, 0.0) for colour, led in LED.items()}  # for a recording


def radiometry(
    measured: RadiometrySpec | None = None,
    field_deg: float = FIELD_DEG,
    leds: int = LEDS,
    lamps: Mapping[Colour, Lamp] | None = None,
    magnification: float = RELAY_MAGNIFICATION,
) -> Radiometry:
    """Return the beam of each colour: as measured, times the guard factor; if unmeasured, the worst case.

    `lamps` are the head's LEDs by colour; None: `leds` LEDs of an APA102-2020 in each of its colours. `magnification`
    of the relay is f1 / f2.
    """
    found: dict[Colour, Beam] = {}
    for colour, lamp in (lamps or {colour: Lamp(led, leds) for colour, led in LED.items()}).items():
        spec = measured.beam(colour) if measured else None
        if measured is None or spec is None:
            found[colour] = worst_beam(colour, field_deg, lamp.count, lamp.led, magnification)
        else:
            scale = measured.guard_factor / 1000
            found[colour] = Beam(
                spec.wavelength_um, scale * spec.retina_mw_per_cm2, scale * spec.waist_mw_per_cm2, spec.fwhm_um
            )
    return found


def worst_beam(
    colour: Colour,
    field_deg: float = FIELD_DEG,
    leds: int = LEDS,
    led: Led | None = None,
    magnification: float = RELAY_MAGNIFICATION,
) -> Beam:
    """Return the worst-case beam of an unmeasured colour: lossless optics, and LEDs brighter by the uncertainty factor.

    `retina` holds the light of all `leds` LEDs, `waist` that of one LED: the LEDs are further apart than the disc of 1
    mm over which the waist irradiance is averaged. The cone is that of the field, and no narrower than the paper's: the
    cap of an unmeasured head may be another one. The spectrum counts as its peak, as the optics' losses are greater.
    """
    led = led or LED[colour]
    half_cone = max(RELAY_HALF_CONE_DEG, half_cone_deg(field_deg, magnification))
    budget = photon_budget(colour, pitch_um=1.0, field_deg=field_deg, led=led, half_cone=half_cone)
    scale = LED_POWER_UNCERTAINTY / TRANSMISSION_TO_EYE / 1000
    return Beam(
        led.wavelength_um,
        scale * budget.retina_mw_per_cm2 * leds / LEDS,
        scale * budget.cornea_mw / LEDS / WAIST_CM2,
    )


@dataclass(frozen=True)
class Hazard:
    """Calculation of irradiances and doses of an illumination of this head, and the check against the limits."""

    beams: Radiometry
    limits: Limits

    def photochemical_w_per_cm2(self, illumination: Illumination) -> float:
        """Return the A-weighted irradiance of the retina, W/cm2."""
        beam = self._beam(illumination)
        weight = self.limits.photochemical_weight.of_spectrum(beam.wavelength_um, beam.fwhm_um)
        return illumination.level * beam.retina_w_per_cm2 * weight

    def thermal_w_per_cm2(self, illumination: Illumination) -> float:
        """Return the R-weighted irradiance of the retina, W/cm2."""
        beam = self._beam(illumination)
        weight = self.limits.thermal_weight.of_spectrum(beam.wavelength_um, beam.fwhm_um)
        return illumination.level * beam.retina_w_per_cm2 * weight

    def waist_w_per_cm2(self, illumination: Illumination) -> float:
        """Return the irradiance in the waist of the beam, unweighted, W/cm2."""
        return illumination.level * self._beam(illumination).waist_w_per_cm2

    def dose_j_per_cm2(self, illumination: Illumination, duration_s: float) -> float:
        """Return the A-weighted retinal dose of an illumination of this duration, J/cm2."""
        return self.photochemical_w_per_cm2(illumination) * max(0.0, duration_s)

    def _beam(self, illumination: Illumination) -> Beam:
        """Return the beam of a colour; LightLimit for a colour whose irradiance is not known: this head has no LED."""
        if illumination.colour not in self.beams:
            raise LightLimit(
                f"this head has no {illumination.colour} LEDs, so their irradiance is not known",
                f"Choose one of {', '.join(self.beams)} in the head file.",
            )
        return self.beams[illumination.colour]

    def refuse(self, illumination: Illumination) -> None:
        """Raise LightLimit, with the permitted level, if an illumination exceeds any of the three irradiance limits."""
        times = self._times(illumination)
        if times > 1:
            percent = 100 * illumination.level
            highest = 100 * self.highest_level(illumination.colour)
            raise LightLimit(
                f"{illumination.colour} light at {percent:.3g} % is {times:.3g} times brighter than an eye may see",
                f"Dim it to {highest:g} % or less, or have the head's light measured.",
            )

    def highest_level(self, colour: Colour) -> float:
        """Return the highest level of a colour within the three irradiance limits, at most 1, in steps of 0.001."""
        return min(1.0, floor(LEVELS / self._times(Illumination(colour))) / LEVELS)

    def brightest(self, colour: Colour) -> Illumination:
        """Return the brightest permitted light of a colour; LightLimit if no level of this head is permitted."""
        if (level := self.highest_level(colour)) <= 0:
            self.refuse(Illumination(colour, 1 / LEVELS))
        return Illumination(colour, level)

    def _times(self, illumination: Illumination) -> float:
        """Return the largest irradiance over its limit."""
        limits = self.limits
        return max(
            self.photochemical_w_per_cm2(illumination) / limits.photochemical_w_per_cm2,
            self.thermal_w_per_cm2(illumination) / limits.thermal_w_per_cm2,
            self.waist_w_per_cm2(illumination) / limits.waist_w_per_cm2,
        )
