"""What a meter said of each LED of the ring: checked, kept with the calibration, and believed by the guard.

    measured = "2026-11-20, PM100D with S120VC"
    [[led]]
    led = 19                  # its number on the chain
    colour = "green"
    peak_nm = 522
    power_mw = 0.017          # into the eye: this LED alone, at full drive
    waist_mw_per_cm2 = 1.8    # in the waist of the beam, mean over the brightest disc of 1 mm

What is missing is unknown: a colour of which any LED is unknown counts at its worst, as one that was never measured.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import pi, radians, tan
from pathlib import Path

from pydantic import Field, model_validator

from device.dose import FIELD_DEG, WAIST_CM2
from device.errors import SpecError
from device.optics.matrix import chain_of, ring
from device.radiometry import BeamSpec, RadiometrySpec
from device.spec import InstrumentSpec
from device.tables import Table, load_toml
from device.values import Colour

PEAK_NM: dict[Colour, tuple[float, float]] = {"red": (600.0, 650.0), "green": (500.0, 560.0), "blue": (440.0, 490.0)}
POWER_MW = (1e-4, 1.0)
WAIST_MW_PER_CM2 = (1e-2, 130.0)
WEAKEST = 0.25  # of the strongest of the same colour: below, an LED is broken, or the meter stood beside it
METER = 1.3  # how far two readings of one beam may disagree
EYE_MM = 17.0  # a human eye, as the limits mean it
COLOURS: tuple[Colour, ...] = ("red", "green", "blue")


class Reading(Table):
    """One LED in one colour, at full drive; None: not measured."""

    led: int
    colour: Colour
    peak_nm: float
    power_mw: float | None = None
    waist_mw_per_cm2: float | None = None

    @model_validator(mode="after")
    def _is_plausible(self) -> "Reading":
        bounds = [("peak_nm", self.peak_nm, PEAK_NM[self.colour]), ("power_mw", self.power_mw, POWER_MW)]
        bounds.append(("waist_mw_per_cm2", self.waist_mw_per_cm2, WAIST_MW_PER_CM2))
        for key, value, (least, most) in bounds:
            if value is not None and not least <= value <= most:
                raise ValueError(
                    f"LED {self.led} in {self.colour}: {value:g} is not between {least:g} and {most:g} ({key})"
                )
        if self.power_mw is not None and self.waist_mw_per_cm2 is not None:
            disc_mw = self.waist_mw_per_cm2 * WAIST_CM2
            if disc_mw > METER * self.power_mw:
                raise ValueError(
                    f"LED {self.led} in {self.colour}: {disc_mw:.3g} mW in a disc of 1 mm are more than the "
                    f"{self.power_mw:g} mW of the whole beam"
                )
        return self


class LedReadings(Table):
    """All readings, when and with what they were made, and the factor that covers the meter's own error."""

    measured: str = Field(min_length=1)
    guard_factor: float = Field(default=1.3, ge=1.3, le=10)
    led: tuple[Reading, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _agree(self) -> "LedReadings":
        seen = set()
        for one in self.led:
            if (one.led, one.colour) in seen:
                raise ValueError(f"LED {one.led} in {one.colour} stands there twice")
            seen.add((one.led, one.colour))
        for colour in COLOURS:
            powers = {one.led: one.power_mw for one in self.led if one.colour == colour and one.power_mw is not None}
            if powers and min(powers.values()) < WEAKEST * max(powers.values()):
                weak = min(powers, key=lambda led: powers[led])
                raise ValueError(
                    f"LED {weak} in {colour}: {powers[weak]:g} mW are {powers[weak] / max(powers.values()):.0%} of the "
                    f"strongest (at least {WEAKEST:.0%})"
                )
        return self

    @property
    def figures(self) -> dict[str, float]:
        """As the manifest keeps them."""
        found = {"leds_guard_factor": self.guard_factor}
        for one in self.led:
            name = f"led_{one.led}_{one.colour}"
            said = {"nm": one.peak_nm, "mw": one.power_mw, "waist_mw_per_cm2": one.waist_mw_per_cm2}
            found |= {f"{name}_{key}": value for key, value in said.items() if value is not None}
        return found


def led_readings(path: Path, spec: InstrumentSpec) -> LedReadings:
    """The technician's file; SpecError, with the number that is wrong, for what no LED of this head's ring can be."""
    read = load_toml(path, LedReadings)
    chain = chain_of(spec)
    if chain is None:
        raise SpecError(f"{spec.name} has no table [light.chain], so it has no LEDs to be measured one by one")
    leds = ring(chain)
    if strange := sorted({one.led for one in read.led} - set(leds)):
        raise SpecError(
            f"{path}: LED {strange[0]} is not on the ring of {spec.name}",
            f"Its LEDs are {', '.join(map(str, leds))}.",
        )
    return read


def unknown(read: LedReadings, spec: InstrumentSpec) -> list[str]:
    """What was not measured, in words."""
    chain = chain_of(spec)
    told = []
    for colour in COLOURS:
        known = {
            one.led for one in read.led if one.colour == colour and None not in (one.power_mw, one.waist_mw_per_cm2)
        }
        if missing := [led for led in (ring(chain) if chain else ()) if led not in known]:
            which = "no LED" if not known else f"not LED {', '.join(map(str, missing))}"
            told.append(f"{colour}: {which} was measured in full; the guard takes this colour at its worst")
    return told


@dataclass(frozen=True)
class _Told:
    nm: float
    mw: float | None
    waist_mw_per_cm2: float | None


def with_measured_light(spec: InstrumentSpec, figures: Mapping[str, float], whence: str) -> InstrumentSpec:
    """The head with the trims and the radiometry that its calibration brings; what its file says itself stays.

    Each LED is trimmed to the weakest in the picture's colour. `whence` says where the figures come from.
    """
    chain = chain_of(spec)
    if chain is None or "leds_guard_factor" not in figures or spec.light.radiometry is not None:
        return spec
    leds = ring(chain)
    said = {colour: [_told(figures, led, colour) for led in leds] for colour in COLOURS}
    trims = chain.trims or _trims(said[spec.light.colour]) or (1.0,) * len(leds)
    field_deg = spec.optics.field_deg if spec.optics else FIELD_DEG
    beam = partial(_beam, trims=trims, field_deg=field_deg)
    beams = {colour: beam(said[colour]) for colour in COLOURS}
    measured = RadiometrySpec(measured=whence, guard_factor=figures["leds_guard_factor"], **beams)
    chain = chain.model_copy(update={"leds": leds, "trims": trims})
    light = spec.light.model_copy(update={"chain": chain, "pupil_mm": None, "radiometry": measured})
    return spec.model_copy(update={"light": light})


def _told(figures: Mapping[str, float], led: int, colour: Colour) -> _Told | None:
    name = f"led_{led}_{colour}"
    if f"{name}_nm" not in figures:
        return None
    return _Told(figures[f"{name}_nm"], figures.get(f"{name}_mw"), figures.get(f"{name}_waist_mw_per_cm2"))


def _trims(said: list[_Told | None]) -> tuple[float, ...] | None:
    """Each LED's drive, so that all are as bright as the weakest; None where one of them is unknown."""
    powers = [one.mw for one in said if one is not None and one.mw is not None]
    return tuple(min(powers) / power for power in powers) if len(powers) == len(said) else None


def _beam(said: list[_Told | None], trims: tuple[float, ...], field_deg: float) -> BeamSpec | None:
    """The whole ring in one colour; None where any of its LEDs is unknown.

    The shortest wavelength stands for all, and the waists are added up: both are the worst that the readings allow.
    """
    known = [(one.nm, one.mw, one.waist_mw_per_cm2) for one in said if one is not None]
    powers = [mw for _, mw, _ in known if mw is not None]
    waists = [waist for _, _, waist in known if waist is not None]
    if not len(powers) == len(waists) == len(trims):
        return None
    lit_cm2 = pi * (EYE_MM / 10 * tan(radians(field_deg / 2))) ** 2
    return BeamSpec(
        wavelength_um=min(nm for nm, _, _ in known) / 1000,
        retina_mw_per_cm2=sum(trim * mw for trim, mw in zip(trims, powers, strict=True)) / lit_cm2,
        waist_mw_per_cm2=sum(trim * waist for trim, waist in zip(trims, waists, strict=True)),
    )
