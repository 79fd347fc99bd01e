"""The model eye's tube: a lens of 25 mm behind a pupil of 7.7 mm, for calibration and for first light.

The eye's own coordinates: its lens's middle is the origin, z runs out of the eye, the retina is at -25 mm.
"""

from math import sqrt

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed import pinhole_piston
from hardware.parts.shapes import cone, rod

UP = (0.0, 0.0, -1.0)
WIDE_MM = 32.0
FRONT_MM = 1.2
LAND_MM = 0.3
SHOULDER_MM = 23.0


def seat_z_mm(d: Dimensions) -> float:
    """Where the round lens lies on the shoulder's inner edge."""
    radius = d.bought.eye_lens_radius_mm
    half = SHOULDER_MM / 2
    return d.bought.eye_lens_thick_mm / 2 - (radius - sqrt(radius**2 - half**2))


def pupil_z_mm(d: Dimensions) -> float:
    """The pupil's sharp edge."""
    return d.bought.eye_lens_thick_mm / 2 + d.fit.slide_mm


def face_z_mm(d: Dimensions) -> float:
    """The tube's front face, with which it stands in the eye collar."""
    return pupil_z_mm(d) + FRONT_MM


def model_eye_tube(d: Dimensions) -> Part:
    """The lens drops in from behind onto a shoulder; the pupil's edge is sharp on the lens's side."""
    part = d.bought
    slide = d.fit.slide_mm
    seat = seat_z_mm(d)
    vertex = pupil_z_mm(d)
    end = face_z_mm(d)
    body = rod(WIDE_MM, (pinhole_piston.rear_z_mm(d), end))
    body -= rod(part.eye_lens_mm + slide, (pinhole_piston.rear_z_mm(d), seat))
    body -= rod(SHOULDER_MM, (seat, vertex)) + rod(part.eye_pupil_mm, (vertex, end))
    return body - cone(part.eye_pupil_mm, part.eye_pupil_mm + 2 * (FRONT_MM - LAND_MM), (vertex + LAND_MM, end))
