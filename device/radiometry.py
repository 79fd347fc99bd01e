"""What a power meter said about one head: its table [light.radiometry], by colour."""

from pydantic import Field

from device.tables import Table
from device.values import Colour


class BeamSpec(Table):
    """One colour with the whole ring at full drive, as measured at the eye.

    `waist` is the mean over the brightest disc of 1 mm in the waist of the beam.
    """

    wavelength_um: float = Field(ge=0.4, le=0.7)
    retina_mw_per_cm2: float = Field(gt=0)
    waist_mw_per_cm2: float = Field(gt=0)


class RadiometrySpec(Table):
    """The measured colours; one that is missing is taken at its worst. `guard_factor` covers the meter's own error."""

    measured: str = Field(min_length=1)  # when, and with what
    guard_factor: float = Field(ge=1.3, le=10)
    red: BeamSpec | None = None
    green: BeamSpec | None = None
    blue: BeamSpec | None = None

    def beam(self, colour: Colour) -> BeamSpec | None:
        """What was measured of a colour."""
        found: BeamSpec | None = getattr(self, colour)
        return found
