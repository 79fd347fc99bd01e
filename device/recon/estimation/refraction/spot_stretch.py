"""Stretch of the PSF of lenslets that comes nearest to the displacements of its spots behind an eye (NUMERICS.md 7.11).

A spot whose cell is not centred on its lens is displaced by the slope at the centroid of the cell, not at its place,
and by the other focus that the lens has at each place of the field. Behind centred cells the stretch is `transform`'s.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from device.recon.estimation.psf_warp import Transform
from device.recon.model.spots import Eye, Spots, power_matrix

TABLE_DPT = np.linspace(-10.5, 10.5, 7)
HIGHEST_PER_UM, LOWEST_SHARE = 0.012, 0.15  # where the detail of a retina exceeds the noise at the light of an eye
FREQUENCIES = 7  # along half an axis
SD_DPT, SD_OF_CORRECTION = 0.015, 0.4  # of each component by the model, and as a share of the curved field's correction
STEPS = 4  # of the displacement with the highest correlation

Floats = NDArray[np.float64]


class SpotStretch:
    """Stretch of the PSF for an eye behind these spots, mean over a field of view (diameter in degrees).

    `sd_dpt`: sd of M, J0 and J45 by this model. Cells that are not centred displace the spots of an eye without
    refraction, too; by random and hexagonal arrays that correction is known to 0.4 of its size (NUMERICS.md 7.11).
    """

    def __init__(self, spots: Spots, field_deg: float) -> None:
        self._scale_per_dpt = spots.geometry.scale_per_dpt
        sphere = [_matrix_of(spots, field_deg, (m_dpt, 0.0, 0.0)) for m_dpt in TABLE_DPT]
        self._spheres = np.array(sphere).reshape(len(TABLE_DPT), 4)
        still = _matrix_of(spots, field_deg, (0.0, 0.0, 0.0))
        by_component = [still[0, 0] + still[1, 1], still[0, 0] - still[1, 1], still[0, 1] + still[1, 0]]
        self.sd_dpt = float(np.hypot(SD_DPT, SD_OF_CORRECTION * np.linalg.norm(by_component) / 2))
        cylinders: tuple[Eye, ...] = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        self._cylinders = [_matrix_of(spots, field_deg, eye) - still for eye in cylinders]

    def __call__(self, m_dpt: float, j0_dpt: float = 0.0, j45_dpt: float = 0.0) -> Transform:
        """Return the stretch for M, J0 and J45, as a matrix on (x, y) = (cols, rows); M within +-10.5 dpt."""
        sphere = np.array([np.interp(m_dpt, TABLE_DPT, column) for column in self._spheres.T]).reshape(2, 2)
        matrix = sphere + j0_dpt * self._cylinders[0] + j45_dpt * self._cylinders[1]
        return np.asarray(np.eye(2) - self._scale_per_dpt * matrix)


@lru_cache(maxsize=4)  # each holds its spots and their PSF
def spot_stretch(spots: Spots, field_deg: float) -> SpotStretch:
    """Return the stretch behind these spots, computed once."""
    return SpotStretch(spots, field_deg)


def _matrix_of(spots: Spots, field_deg: float, eye: Eye) -> Floats:
    """Return the matrix in dpt (an eye's, behind centred cells) whose stretch fits the displacements of the spots best.

    Each displacement counts by what its spot says about it: squared light times the curvature of the correlation.
    """
    scale = spots.geometry.scale_per_dpt
    normal, right_side = np.zeros((4, 4)), np.zeros(4)
    for number, place_um in enumerate(spots.places_um):
        moved_um, curvature = _displacement(spots, number, field_deg, eye)
        weight = spots.light[number] ** 2 * curvature
        slope = -scale * np.kron(np.eye(2), place_um)
        normal += slope.T @ weight @ slope
        right_side += slope.T @ weight @ moved_um
    return np.asarray(np.linalg.solve(normal, right_side).reshape(2, 2))


def _displacement(spots: Spots, number: int, field_deg: float, eye: Eye) -> tuple[Floats, Floats]:
    """Return how far an eye moves a spot, um, (2,), and the curvature of its correlation there, per um^2, (2, 2)."""
    axis = np.arange(-FREQUENCIES, FREQUENCIES + 1) / FREQUENCIES * HIGHEST_PER_UM
    right, down = (part.ravel() for part in np.meshgrid(axis[FREQUENCIES:], axis))
    radius = np.hypot(right, down)
    used = (radius <= HIGHEST_PER_UM) & (radius >= LOWEST_SHARE * HIGHEST_PER_UM)
    right, down = right[used], down[used]
    turns = 2 * np.pi * np.stack([right, down], axis=1)
    calibrated = spots.spectrum(number, spots.focus_dpt[number], right, down)
    both = calibrated.conj() * spots.mean_spectrum(number, eye, field_deg, right, down)
    moved_um = np.zeros(2)
    for _ in range(STEPS):
        aligned = both * np.exp(1j * turns @ moved_um)
        curvature = np.einsum("fi,fj,f->ij", turns, turns, np.abs(aligned))
        moved_um = moved_um - np.linalg.solve(curvature, turns.T @ aligned.imag)
    return moved_um - spots.geometry.scale_per_dpt * power_matrix(np.array(eye)) @ spots.centroids_um[number], curvature
