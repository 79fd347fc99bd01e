"""Trial lens before an eye: the refraction that both have together, at the eye's pupil.

Power vectors are those of the correcting lens (Thibos, Wheeler and Horner 1997), for the eye as the examiner sees it:
x to the right, y up, axes in TABO degrees. A minus cylinder C on the axis alpha with the sphere S is

    M = S + C/2,    J0 = -C/2 cos 2 alpha,    J45 = -C/2 sin 2 alpha,    F = [[M + J0, J45], [J45, M - J0]]

Vergences are followed from the retina outwards (OPTICS.md 1.3): L = V (1 - d V)^-1 + F at the lens, L (1 + d L)^-1
referred back to the pupil, with V = -E for an eye that needs the correction E.
"""

from math import cos, radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class PowerVector(NamedTuple):
    """Correcting lens in dpt: mean sphere M (negative for myopia), J0 and J45."""

    m_dpt: float = 0.0
    j0_dpt: float = 0.0
    j45_dpt: float = 0.0

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Power matrix, (2, 2), dpt."""
        m, j0, j45 = self
        return np.array([[m + j0, j45], [j45, m - j0]])


class TrialLens(NamedTuple):
    """Lens of a trial case: sphere and minus cylinder in dpt, and the cylinder's axis in TABO degrees, 0 to 180."""

    sphere_dpt: float
    cylinder_dpt: float = 0.0
    axis_deg: float = 0.0

    @property
    def label(self) -> str:
        """Its power as on a prescription."""
        if not self.cylinder_dpt:
            return f"{self.sphere_dpt:+.2f}" if self.sphere_dpt else "no lens"
        return f"{self.sphere_dpt:+.2f} / {self.cylinder_dpt:+.2f} x {self.axis_deg:.0f}"

    @property
    def power(self) -> PowerVector:
        """Power vector of the lens itself."""
        half_dpt = -self.cylinder_dpt / 2
        twice_rad = 2 * radians(self.axis_deg)
        return PowerVector(
            self.sphere_dpt + self.cylinder_dpt / 2, half_dpt * cos(twice_rad), half_dpt * sin(twice_rad)
        )


EMMETROPIC = PowerVector()


def correction_behind(lens: TrialLens, vertex_mm: float, eye: PowerVector = EMMETROPIC) -> PowerVector:
    """Return the correction at the pupil of an eye with a trial lens before it, dpt.

    `vertex_mm` is the distance from the lens to the eye's pupil, `eye` the correction that the eye alone needs there.
    A lens of +5 dpt at 12 mm makes an emmetropic eye myopic: -4.72 dpt.
    """
    distance_m = vertex_mm / 1000
    identity = np.eye(2)
    leaving = -eye.matrix
    behind_lens = leaving @ np.linalg.inv(identity - distance_m * leaving) + lens.power.matrix
    seen = -behind_lens @ np.linalg.inv(identity + distance_m * behind_lens)
    return PowerVector(
        float(seen[0, 0] + seen[1, 1]) / 2, float(seen[0, 0] - seen[1, 1]) / 2, float(seen[0, 1] + seen[1, 0]) / 2
    )
