"""Check of lenslets in a calibration's PSF: lenses without a spot of their own, gaps, and centres that have moved."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from device.config.element import Lenses
from device.recon.model.spots import GAP_LIGHT, Spots, find_spots
from device.values import Calibration

ALIGNMENTS = 4  # of spots to lenses: shift and rotation, then the nearest lens again
OWN_SPOT = 1 / 3  # of the distance to the nearest lens: a spot farther away is another lens's
SAME_SPOT_UM = 30.0  # farther away is another lens, or a spot that a fault has displaced
MAX_MISFIT = 0.2  # as drawn 0.03 to 0.06, lenses of 0.15 waves rms
MAX_MOVED_UM = 1.0  # rms along an axis: 2 um cost 0.007 of the correlation of detail (OPTICS.md 2.9)

Places = NDArray[np.float64]


def lens_figures(spots: Spots | None, lenses: Lenses, earlier: Calibration | None) -> dict[str, float]:
    """Return figures of the spots of a PSF for the calibration's record; `spots` is None if there are too few.

    Number of lenses without a spot of their own, light beside the spots (a share), misfit of the spots (a share), mean
    focus in dpt, and, with an earlier calibration of the same lenses, the rms shift of the centres since, um.
    """
    if spots is None:
        return {"lenses_without_spot": float(len(lenses))}
    figures = {
        "lenses_without_spot": float(len(lenses_without_spot(spots, lenses))),
        "lens_light_beside": spots.beside,
        "lens_misfit": spots.misfit,
        "lens_focus_dpt": float(spots.focus_dpt[:, 0].mean()),
    }
    before = None if earlier is None else find_spots(earlier.psfs[0], spots.geometry)
    if before is None:
        return figures
    return figures | {"lens_moved_um": shift_um(before.places_um, spots.places_um)}


def lens_messages(figures: dict[str, float]) -> Iterable[str]:
    """Yield a sentence for each figure of `lens_figures` that is beyond its limit."""
    if missing := figures.get("lenses_without_spot"):
        yield f"lenses without a spot of their own: {missing:.0f}, covered or merged with another lens"
    if (beside := figures.get("lens_light_beside", 0.0)) > GAP_LIGHT:
        yield f"{beside:.0%} of the light passes beside the lenses: see whether there are clear gaps between them"
    if (misfit := figures.get("lens_misfit", 0.0)) > MAX_MISFIT:
        yield (
            f"the spots differ from those of lenses by {misfit:.0%}: see whether the point source is at most 100 um "
            "wide behind a lens of 25 mm, and its stated width is true"
        )
    if (moved_um := figures.get("lens_moved_um", 0.0)) > MAX_MOVED_UM:
        yield f"the centres of the lenses have moved by {moved_um:.1f} um since the calibration before"


def lenses_without_spot(spots: Spots, lenses: Lenses) -> list[int]:
    """Return the numbers, from 1, of the lenses of a layout near which no spot stands, after shift and rotation."""
    centres = np.array(lenses)[:, :2]
    apart = _distances(centres, centres) + np.diag(np.full(len(centres), np.inf))
    placed = _aligned(centres, spots.places_um)
    nearest = _distances(placed, spots.places_um)
    return [number for number, row in enumerate(nearest, 1) if row.min() > OWN_SPOT * apart[number - 1].min()]


def shift_um(before_um: Places, after_um: Places) -> float:
    """Return the rms change along an axis of the places of spots, beside a shift and rotation of all, um.

    Of those that are found again, if these are at least half; else of all, as of another plate.
    """
    placed = _aligned(before_um, after_um)
    apart_um = _distances(placed, after_um)
    is_own = apart_um.min(axis=1) < SAME_SPOT_UM
    if is_own.mean() < 0.5:
        is_own[:] = True
    return float(np.sqrt(np.square(placed - after_um[apart_um.argmin(axis=1)])[is_own].mean()))


def _aligned(places: Places, spots: Places) -> Places:
    """Return places shifted and rotated to the spots nearest to them, in the least-squares sense."""
    placed = places
    for _ in range(ALIGNMENTS):
        near = _distances(placed, spots)
        own = spots[near.argmin(axis=1)]
        is_own = near.min(axis=1) <= 2 * np.median(near.min(axis=1))
        middle, target = places[is_own].mean(axis=0), own[is_own].mean(axis=0)
        left, _, right = np.linalg.svd((places[is_own] - middle).T @ (own[is_own] - target))
        placed = (places - middle) @ left @ right + target
    return placed


def _distances(places: Places, others: Places) -> Places:
    return np.asarray(np.hypot(*(places[:, None] - others[None]).transpose(2, 0, 1)))
