"""The step ring: 4 mm between piston and tube; none, one and two of them are -4, 0 and +4 mm of the screen.

A third, printed at half the height, is for the steps of 2 mm: it alone is -2 mm, beside one of 4 mm +2 mm.
"""

from build123d import Part

from hardware.parts.dimensions import Dimensions
from hardware.parts.printed import pinhole_piston
from hardware.parts.shapes import rod

UP = (0.0, 0.0, 1.0)


def step_ring(d: Dimensions) -> Part:
    """Its thickness is the step, so it is measured with a caliper and entered."""
    rear = pinhole_piston.rear_z_mm(d)
    z = (rear - d.bought.eye_step_mm, rear)
    return rod(pinhole_piston.WIDE_MM, z) - rod(d.bought.eye_lens_mm + d.fit.slide_mm, z)
