"""The pinhole piston: slides into the model eye with a point of light on its nose; step rings set how deep."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import rod

UP = (0.0, 0.0, 1.0)
FLANGE_MM = 4.0
WIDE_MM = 32.0
REAR_Z_MM = -45.0
LED_MM = 5.1  # a white LED of 5 mm, pushed in from behind, with paper before it
WINDOW_MM = 3.0


def rear_z_mm(d: Dimensions) -> float:
    """The end of the model eye's tube, on which flange or step rings lie."""
    return REAR_Z_MM - (d.bought.eye_focal_mm - 25.0)


def nose_z_mm(d: Dimensions, rings: int) -> float:
    """Where the pinhole is with so many step rings: 0 is the near step, 1 the retina, 2 the far step."""
    return -d.bought.eye_focal_mm + (1 - rings) * d.bought.eye_step_mm


def pinhole_piston(d: Dimensions) -> Part:
    """Drawn with one ring, so in focus; the foil lies in a pocket as deep as it is thick."""
    nose = nose_z_mm(d, 1)
    end = rear_z_mm(d) - d.bought.eye_step_mm
    body = rod(d.bought.eye_lens_mm - d.fit.slide_mm, (end, nose)) + rod(WIDE_MM, (end - FLANGE_MM, end))
    foil = rod(d.bought.pinhole_foil_mm + d.fit.slide_mm, (nose - d.bought.pinhole_foil_thick_mm, nose))
    return body - foil - rod(WINDOW_MM, (end, nose)) - rod(LED_MM, (end - FLANGE_MM, nose - 3))
