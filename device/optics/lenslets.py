"""Lenslets at the iris instead of a diffuser: a square array, or equal lenses placed at random; OPTICS.md 2.8.

The paper's future work: "a properly-designed microlens array" (Xue et al. 2020) "or customized aperiodic microlens
array" (Kuo et al. 2020). Each lens has a parabolic surface; where two meet, the higher one counts, so each place
belongs to the lens with the nearest centre, and no light passes beside the lenses.
"""

import math

import numpy as np
from numpy.typing import NDArray

from device.config.scene import DiffuserSpec
from device.values import Image

Places = NDArray[np.float64]

# Nearest centres of lenslets, over the pitch: a filled random packing of such discs has one centre for each square of
# the pitch's side (measured; tests/physics/test_lenslets.py).
CLOSEST = 0.83
CANDIDATES = 24  # lattice points along a pitch, of which the centres are drawn


def focal_um(element: DiffuserSpec, distance_um: float) -> float:
    """Return the focal length of a lens, um: by default the distance to the sensor, so that the sensor is in focus."""
    return element.focal_um or distance_um


def reach_um(element: DiffuserSpec) -> float:
    """Return the largest distance of a place from its lens's centre, um: half a diagonal, or the packing's radius."""
    return element.pitch_um * (math.sqrt(0.5) if element.kind == "microlenses" else CLOSEST)


def steepest_rad(element: DiffuserSpec, distance_um: float) -> float:
    """Return the slope of the ray through the farthest place of a lens, rad: reach / focal length."""
    return reach_um(element) / focal_um(element, distance_um)


def path_um(element: DiffuserSpec, distance_um: float, iris_um: float, x_um: Places, seed: int) -> Image:
    """Return the optical path difference of the lenses, um, on a square grid of the places `x_um` along both axes.

    o(r) = (n - 1) h(r) = -min_i |r - c_i|^2 / (2 f): float32 (samples, samples), zero at each centre, negative beside
    it. Outside of the iris the lenses end, and the path is that of their farthest place.
    """
    reach = reach_um(element)
    focal = focal_um(element, distance_um)
    nearest = np.full((x_um.size, x_um.size), reach**2, np.float32)
    for right_um, down_um in centres_um(element, iris_um, seed):
        rows, cols = (slice(*np.searchsorted(x_um, (at - reach, at + reach))) for at in (down_um, right_um))
        squared = (x_um[rows, None] - down_um) ** 2 + (x_um[None, cols] - right_um) ** 2
        np.minimum(nearest[rows, cols], squared, out=nearest[rows, cols], casting="same_kind")
    return np.asarray(nearest * np.float32(-0.5 / focal))


def centres_um(element: DiffuserSpec, iris_um: float, seed: int) -> Places:
    """Return the centres (right, down) of the lenses that cover the iris, um, (lenses, 2).

    An array has a lens on the axis. Lenslets are a random packing: candidates in random order, each taken that is
    at least CLOSEST pitches from all before; it is filled, so no place of the iris is farther from a centre.
    """
    pitch = element.pitch_um
    half = iris_um / 2 + element.pitch_um
    if element.kind == "microlenses":
        along = np.arange(-math.ceil(half / pitch), math.ceil(half / pitch) + 1) * pitch
        return _pairs(along)
    step = pitch / CANDIDATES
    places = _pairs(np.arange(-math.ceil(half / step), math.ceil(half / step) + 1) * step)
    places = np.random.default_rng((seed, 61)).permutation(places)
    taken = []
    while places.size:
        taken.append(places[0])
        places = places[np.hypot(*(places - places[0]).T) >= CLOSEST * pitch]
    return np.array(taken)


def _pairs(along: NDArray[np.floating]) -> Places:
    """Return all pairs (right, down) of the places along one axis, (pairs, 2)."""
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
