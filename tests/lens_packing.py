"""Centres of lenslets to compare with: a square array, and a random packing of equal discs."""

import math

import numpy as np
from numpy.typing import NDArray

from device.config.element import Lenses, half_widths_um

CLOSEST = 0.83  # of the pitch: a filled packing of discs this far apart has one centre for each square of the pitch
CANDIDATES = 24  # lattice points along a pitch, of which the centres are drawn


def square_array(pitch_um: float, iris_um: float) -> NDArray[np.float64]:
    """Return the centres (right, down) of a square array that covers the iris, one on the axis, um, (lenses, 2)."""
    return _pairs(pitch_um, iris_um / 2 + pitch_um)


def random_packing(pitch_um: float, iris_um: float, seed: int) -> NDArray[np.float64]:
    """Return centres that cover the iris, um, (lenses, 2): each candidate far enough from all before is taken.

    The packing is filled, so no place of the iris is farther from a centre than two centres from each other.
    """
    places = _pairs(pitch_um / CANDIDATES, iris_um / 2 + pitch_um)
    places = np.random.default_rng((seed, 61)).permutation(places)
    taken = []
    while places.size:
        taken.append(places[0])
        places = places[np.hypot(*(places - places[0]).T) >= CLOSEST * pitch_um]
    return np.array(taken)


def lenses_in_iris(centres_um: NDArray[np.float64], focal_um: float, iris_um: float) -> Lenses:
    """Return lenses at those of the centres, (lenses, 2), to which a place of the iris belongs."""
    found = tuple((float(right), float(down), focal_um) for right, down in centres_um)
    return tuple(lens for lens, half_um in zip(found, half_widths_um(found, iris_um), strict=True) if half_um)


def _pairs(step_um: float, half_um: float) -> NDArray[np.float64]:
    along = np.arange(-math.ceil(half_um / step_um), math.ceil(half_um / step_um) + 1) * step_um
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
