"""Whether the point source in another colour makes another PSF: only then is it worth keeping.

Diffraction is all that differs: 0.993 from green to red on 5 um pixels, 0.9995 on 40 um ones, in simulation.
"""

from math import hypot

from device.calibration.dioptres import MOST_SIDEWAYS_DEG, Stretch
from device.errors import CalibrationRefused
from device.values import Colour, Geometry

SAME = 0.995  # correlation after scaling; two measurements of one PSF have 0.999
LEAST_LIKENESS = 0.7
MOST_STRETCH = 0.015  # beyond what the colour error of an eye does (1 dpt, 0.3 %): the source stands elsewhere


def refuse_other_source(colour: Colour, found: Stretch, geometry: Geometry | None) -> None:
    """A source that was moved when its colour was changed, or is not the same."""
    sideways_deg = hypot(*found.moved_px) / geometry.px_per_deg if geometry else 0.0
    remedy = "Change the colour of the source only, and move nothing. Then start again."
    if found.likeness < LEAST_LIKENESS:
        said = f"in {colour} the PSF is another one: correlation {found.likeness:.2f} (at least {LEAST_LIKENESS})"
        raise CalibrationRefused(said, remedy)
    if abs(found.scale - 1) > MOST_STRETCH:
        said = f"in {colour} the PSF is stretched by {found.scale - 1:+.2%} (at most {MOST_STRETCH:.1%})"
        raise CalibrationRefused(said, remedy)
    if sideways_deg > MOST_SIDEWAYS_DEG:
        said = f"in {colour} the source stands {sideways_deg:.2f} degrees beside where it was"
        raise CalibrationRefused(f"{said} (at most {MOST_SIDEWAYS_DEG})", remedy)


def differs(found: Stretch) -> bool:
    """Whether the PSF of another colour is one of its own."""
    return found.likeness < SAME
