"""The chart piston: slides into the model eye in place of the pinhole piston, with a printed retina on its nose."""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed import pinhole_piston
from hardware.parts.shapes import rod

UP = (0.0, 0.0, 1.0)
NOTCH_MM = 3.0  # half-round, in the rim of the flange: which way is up


def nose_z_mm(d: Dimensions) -> float:
    """The face under the paper, with one step ring: the paper's front is at the focal distance of the lens."""
    return pinhole_piston.nose_z_mm(d, 1) - d.bought.chart_paper_mm


def chart_piston(d: Dimensions) -> Part:
    """Drawn with one ring, so in focus; a notch in the flange marks the top of the chart."""
    nose = nose_z_mm(d)
    end = pinhole_piston.rear_z_mm(d) - d.bought.eye_step_mm
    flange = (end - pinhole_piston.FLANGE_MM, end)
    body = rod(d.bought.eye_lens_mm - d.fit.slide_mm, (end, nose)) + rod(pinhole_piston.WIDE_MM, flange)
    return body - rod(NOTCH_MM, flange, (0, pinhole_piston.WIDE_MM / 2))
