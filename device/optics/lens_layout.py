"""Layouts of lenslets: centroidal packing of any number of lenses, and the stock hexagonal array; OPTICS.md 2.8."""

import math

import numpy as np
from numpy.typing import NDArray

from device.config.element import COLUMNS, Lenses, half_widths_um, iris_places_um, nearest

PLACES, ROUNDS = 160, 200
SETTLED_UM = 0.5  # largest shift of a vertex in the last round

Places = NDArray[np.float64]


def centroidal(count: int, iris_um: float, focal_um: float, seed: int) -> Lenses:
    """Return `count` lenses whose vertices are the centroids of their cells (Lloyd's iteration), aperiodic by the seed.

    A defocused spot then stays where its lens is: the light of a cell has its centroid at the vertex.
    """
    places, _ = iris_places_um(iris_um, PLACES)
    lenses = _lenses(np.random.default_rng((seed, count)).permutation(places)[:count], focal_um)
    for _ in range(ROUNDS):
        owners = nearest(places, lenses)
        areas = np.bincount(owners, minlength=count)
        sums = (np.bincount(owners, places[:, axis], minlength=count) for axis in (0, 1))
        centroids = np.stack([total / areas for total in sums], axis=-1)
        moved_um = float(np.abs(centroids - np.array(lenses)[:, :2]).max())
        lenses = _lenses(centroids, focal_um)
        if moved_um < SETTLED_UM:
            break
    return lenses


def hexagonal(pitch_um: float, iris_um: float, focal_um: float) -> Lenses:
    """Return the lenses of a hexagonal array, one on the axis, on whose cells light of the iris falls."""
    order = np.arange(-math.ceil(iris_um / pitch_um) - 1, math.ceil(iris_um / pitch_um) + 2)
    across, along = (axis.ravel() for axis in np.meshgrid(order, order))
    places = np.stack([across + along / 2, along * math.sqrt(0.75)], axis=-1) * pitch_um
    lenses = _lenses(places, focal_um)
    return tuple(lens for lens, half_um in zip(lenses, half_widths_um(lenses, iris_um), strict=True) if half_um)


def layout_csv(lenses: Lenses) -> str:
    """Return the layout as the text of a head's layout file, um, to a hundredth."""
    rows = ["{:.2f},{:.2f},{:.1f}".format(*lens) for lens in lenses]
    return "\n".join([",".join(COLUMNS), *rows]) + "\n"


def _lenses(centres_um: Places, focal_um: float) -> Lenses:
    return tuple((float(right), float(down), focal_um) for right, down in centres_um)
