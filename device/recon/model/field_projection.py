"""Where a place of the retina stands in the pictures of two gaze directions: on the plane, or on the sphere.

A picture is linear in the field angle: a direction at the angle t from the axis stands at t times the scale from the
centre, at its own azimuth. An eye that turns in front of the instrument rotates the directions of its retina as a rigid
body, whatever its optics are, as long as the instrument stays at its pupil. So two pictures differ by a rotation of the
sphere of directions; a shift with a rotation of the plane is its limit for small fields. NUMERICS.md 11.
"""

from dataclasses import dataclass
from math import atan2, degrees, radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
WIDEST_DEG = 90.0  # from the axis to the corner of a picture


@dataclass(frozen=True)
class Motion:
    """Motion of the retina from one picture to another: shift (rows, cols), then rotation about the centre.

    On the sphere the shift is the rotation that takes the centre straight to that place. `rotation_deg` is
    counter-clockwise as displayed.
    """

    shift: tuple[float, float]
    rotation_deg: float


STILL = Motion((0.0, 0.0), 0.0)


class FieldProjection(Protocol):
    """Map between two pictures of one retina; places are (..., 2), rows and cols from the centre of the picture."""

    def moved(self, places: Floats, motion: Motion) -> Floats:
        """Return where the places of the first picture stand in the second."""

    def moved_back(self, places: Floats, motion: Motion) -> Floats:
        """Return where the places of the second picture stand in the first."""

    def composed(self, first: Motion, then: Motion) -> Motion:
        """Return the motion of both, one after the other."""


class Plane:
    """Pictures whose scale in degrees is unknown: p -> R(p + shift)."""

    def moved(self, places: Floats, motion: Motion) -> Floats:
        """Return R(p + shift)."""
        return np.asarray((places + np.array(motion.shift)) @ rotation_matrix(motion.rotation_deg).T)

    def moved_back(self, places: Floats, motion: Motion) -> Floats:
        """Return R^-1 q - shift."""
        return np.asarray(places @ rotation_matrix(motion.rotation_deg) - np.array(motion.shift))

    def composed(self, first: Motion, then: Motion) -> Motion:
        """Return R2(R1(p + s1) + s2) = R2 R1 (p + s1 + R1^-1 s2)."""
        own = rotation_matrix(-first.rotation_deg) @ np.array(then.shift)
        shift = first.shift[0] + float(own[0]), first.shift[1] + float(own[1])
        return Motion(shift, first.rotation_deg + then.rotation_deg)


@dataclass(frozen=True)
class Sphere:
    """Pictures with a known scale, in their own pixels or samples per degree of field."""

    per_deg: float

    def moved(self, places: Floats, motion: Motion) -> Floats:
        """Return the places of the rotated directions."""
        return self._places(self._directions(places) @ self._matrix(motion).T)

    def moved_back(self, places: Floats, motion: Motion) -> Floats:
        """Return the places of the directions that are rotated back."""
        return self._places(self._directions(places) @ self._matrix(motion))

    def composed(self, first: Motion, then: Motion) -> Motion:
        """Return the motion whose rotation matrix is the product of both."""
        matrix = self._matrix(then) @ self._matrix(first)
        away = self._places(matrix[2])  # the centre of the second picture stands in the first at minus the shift
        shift = 0.0 - float(away[0]), 0.0 - float(away[1])
        about = matrix @ self._matrix(Motion(shift, 0.0)).T
        return Motion(shift, degrees(atan2(about[1, 0], about[0, 0])))

    def _directions(self, places: Floats) -> Floats:
        """Return unit vectors (..., 3): rows, cols, axis."""
        angle = np.radians(np.hypot(places[..., 0], places[..., 1]) / self.per_deg)
        off_axis = np.sinc(angle / np.pi)[..., None] * np.radians(places / self.per_deg)
        return np.concatenate([off_axis, np.cos(angle)[..., None]], axis=-1)

    def _places(self, directions: Floats) -> Floats:
        sine = np.hypot(directions[..., 0], directions[..., 1])
        angle = np.arctan2(sine, directions[..., 2])
        stretch = np.where(sine > 1e-12, np.degrees(angle) / np.maximum(sine, 1e-12), degrees(1.0))
        return np.asarray(directions[..., :2] * stretch[..., None] * self.per_deg)

    def _matrix(self, motion: Motion) -> Floats:
        """Return the rotation of directions (3, 3): the axis straight to the shift's place, then about the axis."""
        row, col, cosine = self._directions(np.array(motion.shift, np.float64))
        off = np.array([row, col])
        turn = np.eye(3)
        turn[:2, :2] -= np.outer(off, off) / (1 + cosine)
        turn[:2, 2], turn[2, :2], turn[2, 2] = off, -off, cosine
        about = np.eye(3)
        about[:2, :2] = rotation_matrix(motion.rotation_deg)
        return np.asarray(about @ turn)


def rotation_matrix(rotation_deg: float) -> Floats:
    """Return the matrix on (rows down, cols right) that turns counter-clockwise as displayed."""
    c = np.cos(radians(rotation_deg))
    s = np.sin(radians(rotation_deg))
    return np.array([[c, -s], [s, c]])
