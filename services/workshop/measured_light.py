"""Power meter's reading of a ring: its plausibility, its shares of the limits, and the lines of the head file."""

from dataclasses import dataclass, replace
from typing import get_args

from device.config.head_file import InstrumentSpec
from device.config.radiometry import LED_FWHM_UM, WAIST_CM2, BeamSpec, RadiometrySpec
from device.errors import SettingError, SpecError
from device.light_safety.hazard import LED_POWER_UNCERTAINTY, Limits
from device.optics.budget import Design
from device.optics.illumination import TRANSMISSION_TO_EYE
from device.optics.led_cap import highest_mw_per_cm2
from device.optics.light_budget import chain, cornea_mw
from device.optics.matrix import lamps_of
from device.values import Colour
from services.workshop.light_report import (
    AXIS_HOLE_SR,
    LimitShare,
    expected_beam,
    expected_uw,
    limit_shares,
    permitted_level,
)

PEAK_TOLERANCE_UM = 0.02  # between data sheet and reading
MAX_OF_BEAM = 1.3  # in the waist's disc, of the beam by the reading on the axis: the error of two readings


@dataclass(frozen=True)
class MeterReading:
    """Reading of the whole ring in one colour at full drive: on the axis, and in the waist.

    `axis_uw` is the highest power behind a hole of AXIS_HOLE_MM, AXIS_DISTANCE_MM behind the pupil: it gives the
    intensity, and so the highest irradiance of a retina (OPTICS.md 4.9). `waist_mw_per_cm2` is the mean over the
    brightest disc of 1 mm, at the waist: the narrowest place of the beam; `meter` names instrument and date; `fwhm_nm`
    is the spectrum's width.
    """

    colour: Colour
    axis_uw: float
    waist_mw_per_cm2: float
    peak_nm: float
    meter: str
    guard_factor: float = 1.3
    fwhm_nm: float = 1000 * LED_FWHM_UM

    def scaled(self, level: float) -> "MeterReading":
        """Return the reading at full drive of one that was taken at `level` (0 to 1] of it: the drive is a PWM."""
        return replace(self, axis_uw=self.axis_uw / level, waist_mw_per_cm2=self.waist_mw_per_cm2 / level)


@dataclass(frozen=True)
class MeteredLight:
    """Judged reading: radiometry for the head file, shares of the limits at full drive, permitted drive."""

    radiometry: RadiometrySpec
    shares: tuple[LimitShare, ...]
    permitted_level: float

    @property
    def is_go(self) -> bool:
        """Whether the ring may shine at full drive into an eye, as far as its light is concerned."""
        return self.permitted_level >= 1


def in_colour(spec: InstrumentSpec, colour: str) -> InstrumentSpec:
    """Return the head with another colour for its pictures; SettingError for a word that is no colour.

    SpecError for a head without LEDs of that colour.
    """
    known: tuple[Colour, ...] = get_args(Colour)
    found = next((name for name in known if name == colour), None)
    if found is None:
        raise SettingError(f"no colour is called {colour!r}", f"Choose one of {', '.join(known)}.")
    lamps = lamps_of(spec)
    if lamps is not None and found not in lamps:
        raise SpecError(f"{spec.name} has no {found} LEDs", f"Choose one of {', '.join(lamps)}.")
    return spec.model_copy(update={"light": spec.light.model_copy(update={"colour": found})})


def judge(spec: InstrumentSpec, design: Design, reading: MeterReading, limits: Limits) -> MeteredLight:
    """Return the judgement of a reading; `design` is that of the head in the reading's colour.

    SpecError for a head without LEDs of its own, or not of that colour. SettingError for a reading that such LEDs
    cannot give: more power than lossless optics with LEDs twice as bright, more in the waist than MAX_OF_BEAM times
    what the reading on the axis gives, another wavelength; and for one below a thousandth of what is expected, of a
    lamp that was off.
    """
    lamp = (lamps_of(spec) or {}).get(reading.colour)
    if lamp is None:
        raise SpecError(f"{spec.name} has no {reading.colour} LEDs", "Give the head file whose ring was measured.")
    unmeasured = replace(design, led=lamp.led, radiometry=None)
    _refuse_implausible(reading, lamp.led.wavelength_um, unmeasured)
    intensity_mw_per_sr = reading.axis_uw / 1000 / AXIS_HOLE_SR
    beam = BeamSpec(
        wavelength_um=reading.peak_nm / 1000,
        fwhm_um=reading.fwhm_nm / 1000,
        retina_mw_per_cm2=highest_mw_per_cm2(intensity_mw_per_sr, design.path.eye.focal_mm),
        waist_mw_per_cm2=reading.waist_mw_per_cm2,
    )
    found = RadiometrySpec(
        measured=reading.meter, guard_factor=reading.guard_factor, **{reading.colour: beam}
    )  # the other colours stay at their worst
    shares = limit_shares(design, expected_beam(replace(design, radiometry=found)), limits)
    return MeteredLight(found, shares, permitted_level(shares))


def _refuse_implausible(reading: MeterReading, wavelength_um: float, unmeasured: Design) -> None:
    """Raise SettingError for a reading that the ring of an unmeasured design cannot give."""
    usual_uw = expected_uw(unmeasured)
    brightest = LED_POWER_UNCERTAINTY / TRANSMISSION_TO_EYE
    if not usual_uw / 1000 < reading.axis_uw <= usual_uw * brightest:
        raise SettingError(
            f"{reading.axis_uw:g} uW are not between {usual_uw / 1000:.2g} and {usual_uw * brightest:.2g} uW, which "
            f"such a ring can give behind the hole on the axis; {usual_uw:.2g} uW are expected",
            "Check the hole, its distance, the meter's range and wavelength, that the lamp was on in this colour, and "
            "the head file.",
        )
    beam_mw = cornea_mw(chain(unmeasured)) * reading.axis_uw / usual_uw
    if reading.waist_mw_per_cm2 * WAIST_CM2 > MAX_OF_BEAM * beam_mw:
        raise SettingError(
            f"{reading.waist_mw_per_cm2:g} mW/cm2 over a disc of 1 mm are more than the {beam_mw:.2g} mW of the whole "
            f"beam, by {reading.axis_uw:g} uW on the axis",
            "Measure both again.",
        )
    if abs(reading.peak_nm / 1000 - wavelength_um) > PEAK_TOLERANCE_UM:
        raise SettingError(
            f"a peak at {reading.peak_nm:g} nm is not that of LEDs of {1000 * wavelength_um:.0f} nm",
            "Check the spectrometer, and which LEDs are fitted.",
        )


def words(reading: MeterReading, found: MeteredLight) -> str:
    """Return the shares of the limits, GO or NO GO, and the lines for the head file."""
    beam = found.radiometry.beam(reading.colour)
    assert beam is not None
    verdict = (
        "GO: full drive keeps every limit"
        if found.is_go
        else (f"NO GO at full drive: the guard permits {found.permitted_level:g} of it")
    )
    return "\n".join(
        [
            *(
                f"{share.name:<14} {share.value:>9.3g} of {share.limit:g} {share.unit}: {share.used:.0%}"
                for share in found.shares
            ),
            verdict,
            "",
            "[light.radiometry]",
            f'measured = "{reading.meter}"',
            f"guard_factor = {reading.guard_factor:g}",
            f"[light.radiometry.{reading.colour}]",
            f"wavelength_um = {beam.wavelength_um:g}",
            f"fwhm_um = {beam.fwhm_um:g}",
            f"retina_mw_per_cm2 = {beam.retina_mw_per_cm2:.4g}",
            f"waist_mw_per_cm2 = {beam.waist_mw_per_cm2:g}",
        ]
    )
