"""Measured radiometry of one head by colour: table [light.radiometry]."""

from math import pi

from pydantic import Field

from device.config.toml_file import Table
from device.values import Colour

WAIST_CM2 = pi * 0.05**2  # a disc of 1 mm
LED_FWHM_UM = 0.035  # of a spectrum that was not measured: the wide end of green LEDs, 30 to 35 nm (an estimate)
FIELD_DEG = 33.4  # the paper's; default of a head without [optics]


class BeamSpec(Table):
    """Irradiance of one colour with the whole ring at full drive: the highest of a retina, and in the beam's waist.

    `retina_mw_per_cm2` is the highest local one, intensity on the axis over the square of 17 mm (OPTICS.md 4.9).
    `waist_mw_per_cm2` is the mean over the brightest disc of 1 mm diameter. `wavelength_um` is the peak of the spectrum
    and `fwhm_um` its full width at half maximum.
    """

    wavelength_um: float = Field(ge=0.4, le=0.7)
    fwhm_um: float = Field(default=LED_FWHM_UM, ge=0, le=0.1)
    retina_mw_per_cm2: float = Field(gt=0)
    waist_mw_per_cm2: float = Field(gt=0)


class RadiometrySpec(Table):
    """Measured colours; a colour that is None counts at its worst case. `guard_factor` covers the meter's error."""

    measured: str = Field(min_length=1)  # date and instrument
    guard_factor: float = Field(ge=1.3, le=10)
    red: BeamSpec | None = None
    green: BeamSpec | None = None
    blue: BeamSpec | None = None
    amber: BeamSpec | None = None

    def beam(self, colour: Colour) -> BeamSpec | None:
        """Return the measurement of a colour; None if not measured."""
        found: BeamSpec | None = getattr(self, colour)
        return found
