"""Similarity between two PSFs of the same lenslets, by the places of their spots.

A stretch does not turn one into the other: a lens moves its spot by the slope of the wavefront at the centroid of its
cell, and blurs it by its own defocus (NUMERICS.md 7.11).
"""

import numpy as np
from scipy import ndimage

from device.recon.model.spots import Floats, find_spots
from device.values import Geometry, Psf

NEIGHBOUR_UM = 150.0  # farther away is another lens's spot; 10 dpt move the outermost spot by 54 um
MIN_MATCHED = 0.8  # of the spots
MIN_LIGHT = 0.01  # of the brightest pixel of the model: what is dimmer is noise


def fit_spots(of: Psf, into: Psf, geometry: Geometry) -> tuple[float, tuple[float, float], float] | None:
    """Return the scale 1 - k M, the shift (rows, cols) in pixels, and the correlation that turn `of` into `into`.

    None behind a diffuser, and where the spots do not belong to each other.
    """
    first, second = find_spots(of, geometry), find_spots(into, geometry)
    if first is None or second is None:
        return None
    apart_um = np.hypot(*(first.places_um[:, None] - second.places_um[None]).transpose(2, 0, 1))
    own = apart_um.argmin(axis=1)
    is_own = apart_um.min(axis=1) < NEIGHBOUR_UM
    if is_own.mean() < MIN_MATCHED:
        return None
    stretch, moved_um = _stretch_and_shift(
        first.centroids_um[is_own], (second.places_um[own] - first.places_um)[is_own]
    )
    model = first.of_eye((stretch / geometry.scale_per_dpt, 0.0, 0.0)).pixels
    right_px, down_px = moved_um / geometry.pitch_um
    moved = np.fft.irfft2(ndimage.fourier_shift(np.fft.rfft2(model), (down_px, right_px), model.shape[1]), model.shape)
    is_lit = ndimage.maximum_filter(moved, 5) > MIN_LIGHT * moved.max()
    likeness = float(np.corrcoef(moved[is_lit], into.pixels[is_lit])[0, 1])
    return 1 - stretch, (float(down_px), float(right_px)), likeness


def _stretch_and_shift(centroids_um: Floats, moved_um: Floats) -> tuple[float, Floats]:
    """Return s and t of the line moved = t - s centroid through the spots, in the least-squares sense."""
    centred = centroids_um - centroids_um.mean(axis=0)
    stretch = -float((centred * moved_um).sum() / np.square(centred).sum())
    return stretch, moved_um.mean(axis=0) + stretch * centroids_um.mean(axis=0)
