"""The iris: a disc with a sharp edge that touches the diffuser, and opens at 45 degrees towards the eye."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.shapes import cone, rod

UP = (0.0, 0.0, -1.0)  # the land lies on the printer's bed, where it is sharpest
THICK_MM = 1.0
LAND_MM = 0.2  # one layer: a longer edge would cut oblique light


def iris(d: Dimensions) -> Part:
    """As wide as the diffuser, so that one bore centres both."""
    opening = cone(d.iris_mm, d.iris_mm + 2 * (THICK_MM - LAND_MM), (-LAND_MM, -THICK_MM))
    return rod(d.bought.diffuser_mm, (-THICK_MM, 0)) - rod(d.iris_mm, (-THICK_MM, 0)) - opening
