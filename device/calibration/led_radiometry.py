"""Radiometer readings of each LED of the ring: checked, stored with the calibration, and used by the light guard.

    measured = "2026-11-20, PM100D with S120VC"
    [[led]]
    led = 19                  # its number on the chain
    colour = "green"
    peak_nm = 522
    power_mw = 0.017          # into the eye: this LED alone, at full drive
    waist_mw_per_cm2 = 1.8    # in the waist of the beam, mean over the brightest disc of 1 mm

A missing value is unknown: a colour with any unknown LED counts with its worst case, like an unmeasured colour.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import pi, radians, tan
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from device.config.head_file import InstrumentSpec
from device.config.radiometry import FIELD_DEG, WAIST_CM2, BeamSpec, RadiometrySpec
from device.config.toml_file import Table, load_toml
from device.errors import SpecError
from device.optics.matrix import chain_of, ring
from device.values import Colour

PEAK_NM: dict[Colour, tuple[float, float]] = {"red": (600.0, 650.0), "green": (500.0, 560.0), "blue": (440.0, 490.0)}
POWER_MW = (1e-4, 1.0)
WAIST_MW_PER_CM2 = (1e-2, 130.0)
MIN_POWER_SHARE = 0.25  # of the strongest of the same colour: a weaker LED is broken or was misaligned with the meter
MAX_METER_RATIO = 1.3  # largest ratio between two readings of one beam
MAX_CENTRE_OVER_MEAN = 1.4  # highest irradiance of a retina over that of the power spread evenly (OPTICS.md 4.9)
EYE_MM = 17.0  # focal length of the eye model of the exposure limits
COLOURS: tuple[Colour, ...] = ("red", "green", "blue")


class LedReading(Table):
    """Reading of one LED in one colour at full drive; power and waist irradiance are None if not measured."""

    led: int
    colour: Literal["red", "green", "blue"]  # of an APA102
    peak_nm: float
    power_mw: float | None = None
    waist_mw_per_cm2: float | None = None

    @model_validator(mode="after")
    def _is_plausible(self) -> "LedReading":
        """Raise ValueError if a value is outside the range of such LEDs, or if two values contradict each other."""
        bounds = [("peak_nm", self.peak_nm, PEAK_NM[self.colour]), ("power_mw", self.power_mw, POWER_MW)]
        bounds.append(("waist_mw_per_cm2", self.waist_mw_per_cm2, WAIST_MW_PER_CM2))
        for key, value, (least, most) in bounds:
            if value is not None and not least <= value <= most:
                raise ValueError(
                    f"LED {self.led} in {self.colour}: {value:g} is not between {least:g} and {most:g} ({key})"
                )
        if self.power_mw is not None and self.waist_mw_per_cm2 is not None:
            disc_mw = self.waist_mw_per_cm2 * WAIST_CM2
            if disc_mw > MAX_METER_RATIO * self.power_mw:
                raise ValueError(
                    f"LED {self.led} in {self.colour}: {disc_mw:.3g} mW in a disc of 1 mm are more than the "
                    f"{self.power_mw:g} mW of the whole beam"
                )
        return self


class LedReadings(Table):
    """All readings (`led`), date and radiometer (`measured`), and the guard factor for the radiometer's error."""

    measured: str = Field(min_length=1)
    guard_factor: float = Field(default=1.3, ge=1.3, le=10)
    led: tuple[LedReading, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _agree(self) -> "LedReadings":
        """Raise ValueError for a duplicate reading, or for an LED far weaker than the others of its colour."""
        seen = set()
        for reading in self.led:
            if (reading.led, reading.colour) in seen:
                raise ValueError(f"LED {reading.led} in {reading.colour} stands there twice")
            seen.add((reading.led, reading.colour))
        for colour in COLOURS:
            powers = {
                reading.led: reading.power_mw
                for reading in self.led
                if reading.colour == colour and reading.power_mw is not None
            }
            if powers and min(powers.values()) < MIN_POWER_SHARE * max(powers.values()):
                weak = min(powers, key=lambda led: powers[led])
                raise ValueError(
                    f"LED {weak} in {colour}: {powers[weak]:g} mW are {powers[weak] / max(powers.values()):.0%} of the "
                    f"strongest (at least {MIN_POWER_SHARE:.0%})"
                )
        return self

    @property
    def figures(self) -> dict[str, float]:
        """Return the guard factor and all known readings as figures of the manifest, such as `led_19_green_mw`."""
        found = {"leds_guard_factor": self.guard_factor}
        for reading in self.led:
            name = f"led_{reading.led}_{reading.colour}"
            values = {"nm": reading.peak_nm, "mw": reading.power_mw, "waist_mw_per_cm2": reading.waist_mw_per_cm2}
            found |= {f"{name}_{key}": value for key, value in values.items() if value is not None}
        return found


def load_led_readings(path: Path, spec: InstrumentSpec) -> LedReadings:
    """Return the readings of a technician's file; SpecError names an implausible value or an LED outside the ring."""
    read = load_toml(path, LedReadings)
    chain = chain_of(spec)
    if chain is None:
        raise SpecError(f"{spec.name} has no table [light.chain], so it has no LEDs to be measured one by one")
    leds = ring(chain)
    if strange := sorted({reading.led for reading in read.led} - set(leds)):
        raise SpecError(
            f"{path}: LED {strange[0]} is not on the ring of {spec.name}",
            f"Its LEDs are {', '.join(map(str, leds))}.",
        )
    return read


def missing_readings(read: LedReadings, spec: InstrumentSpec) -> list[str]:
    """Return one sentence for each colour in which an LED of the ring lacks its power or waist reading."""
    chain = chain_of(spec)
    messages = []
    for colour in COLOURS:
        known = {
            reading.led
            for reading in read.led
            if reading.colour == colour and None not in (reading.power_mw, reading.waist_mw_per_cm2)
        }
        if missing := [led for led in (ring(chain) if chain else ()) if led not in known]:
            which = "no LED" if not known else f"not LED {', '.join(map(str, missing))}"
            messages.append(f"{colour}: {which} was measured in full; the guard takes this colour at its worst")
    return messages


@dataclass(frozen=True)
class _StoredReading:
    """Stored reading of one LED: peak wavelength, power, irradiance in the waist; None means not measured."""

    nm: float
    mw: float | None
    waist_mw_per_cm2: float | None


def with_led_radiometry(spec: InstrumentSpec, figures: Mapping[str, float], source: str) -> InstrumentSpec:
    """Return the head's specification with the LED trims and the radiometry of its calibration.

    Unchanged without a ring or readings, or if the head file has a radiometry; trims of the head file are kept. Else
    each LED is trimmed to the weakest LED in the picture's colour. `source` names the origin of the figures.
    """
    chain = chain_of(spec)
    if chain is None or "leds_guard_factor" not in figures or spec.light.radiometry is not None:
        return spec
    leds = ring(chain)
    readings = {colour: [_stored_reading(figures, led, colour) for led in leds] for colour in COLOURS}
    trims = chain.trims or _trims(readings[spec.light.colour]) or (1.0,) * len(leds)
    field_deg = spec.optics.field_deg if spec.optics else FIELD_DEG
    beam = partial(_beam, trims=trims, field_deg=field_deg)
    beams = {colour: beam(readings[colour]) for colour in COLOURS}
    measured = RadiometrySpec(measured=source, guard_factor=figures["leds_guard_factor"], **beams)
    chain = chain.model_copy(update={"leds": leds, "trims": trims})
    light = spec.light.model_copy(update={"chain": chain, "pupil_mm": None, "radiometry": measured})
    return spec.model_copy(update={"light": light})


def _stored_reading(figures: Mapping[str, float], led: int, colour: Colour) -> _StoredReading | None:
    """Return the stored reading of one LED in one colour; None if there is none."""
    name = f"led_{led}_{colour}"
    if f"{name}_nm" not in figures:
        return None
    return _StoredReading(figures[f"{name}_nm"], figures.get(f"{name}_mw"), figures.get(f"{name}_waist_mw_per_cm2"))


def _trims(readings: list[_StoredReading | None]) -> tuple[float, ...] | None:
    """Return the drive (0 to 1) of each LED that makes all as bright as the weakest; None if any power is unknown."""
    powers = [reading.mw for reading in readings if reading is not None and reading.mw is not None]
    return tuple(min(powers) / power for power in powers) if len(powers) == len(readings) else None


def _beam(readings: list[_StoredReading | None], trims: tuple[float, ...], field_deg: float) -> BeamSpec | None:
    """Return the beam of the whole ring in one colour; None if any LED is unknown.

    The shortest wavelength counts for all LEDs and the waist irradiances are added: the worst case of the readings. A
    power does not say how the light is spread over the field, so the narrowest cap within its tolerances is assumed.
    """
    known = [(reading.nm, reading.mw, reading.waist_mw_per_cm2) for reading in readings if reading is not None]
    powers = [mw for _, mw, _ in known if mw is not None]
    waists = [waist for _, _, waist in known if waist is not None]
    if not len(powers) == len(waists) == len(trims):
        return None
    lit_cm2 = pi * (EYE_MM / 10 * tan(radians(field_deg / 2))) ** 2 / MAX_CENTRE_OVER_MEAN
    return BeamSpec(
        wavelength_um=min(nm for nm, _, _ in known) / 1000,
        retina_mw_per_cm2=sum(trim * mw for trim, mw in zip(trims, powers, strict=True)) / lit_cm2,
        waist_mw_per_cm2=sum(trim * waist for trim, waist in zip(trims, waists, strict=True)),
    )
