"""Decision whether the PSF of another illumination colour is stored separately.

Colours differ by diffraction only: correlation 0.993 from green to red on 5 um pixels, 0.9995 on 40 um pixels, in
simulation.
"""

from math import hypot

from device.calibration.procedure.dioptres import MAX_SIDEWAYS_DEG, PsfSimilarity
from device.errors import CalibrationRefused
from device.values import Colour, Geometry

SAME_PSF_CORRELATION = 0.995  # correlation after scaling; two measurements of one PSF have 0.999
MIN_LIKENESS = 0.7
MAX_STRETCH = 0.015  # above the chromatic error of an eye (1 dpt, 0.3 %): the source has moved


def refuse_moved_source(colour: Colour, found: PsfSimilarity, geometry: Geometry | None) -> None:
    """Raise CalibrationRefused if the source moved when its colour changed, or if the PSF is a different one."""
    sideways_deg = hypot(*found.moved_px) / geometry.px_per_deg if geometry else 0.0
    remedy = "Change the colour of the source only, and move nothing. Then start again."
    if found.correlation < MIN_LIKENESS:
        message = f"in {colour} the PSF is another one: correlation {found.correlation:.2f} (at least {MIN_LIKENESS})"
        raise CalibrationRefused(message, remedy)
    if abs(found.scale - 1) > MAX_STRETCH:
        message = f"in {colour} the PSF is stretched by {found.scale - 1:+.2%} (at most {MAX_STRETCH:.1%})"
        raise CalibrationRefused(message, remedy)
    if sideways_deg > MAX_SIDEWAYS_DEG:
        message = f"in {colour} the source stands {sideways_deg:.2f} degrees beside where it was"
        raise CalibrationRefused(f"{message} (at most {MAX_SIDEWAYS_DEG})", remedy)


def needs_separate_psf(found: PsfSimilarity) -> bool:
    """Return whether the PSF of another colour must be stored separately: correlation below SAME_PSF_CORRELATION."""
    return found.correlation < SAME_PSF_CORRELATION
