"""Rasterisation of vessels: anti-aliased, tapered strokes from paths in degrees."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device.sim.vessels import Vessel
from device.values import Image, Mask

FAR = np.float32(1e3)
SPACING_PX = 0.4  # between the discs that make up a stroke
FULL_WIDTH_DEG = 0.34  # width at which a vessel reaches full contrast


@dataclass(frozen=True)
class Strokes:
    """Rasterised vessels, (rows, cols): `blood` is the attenuation by blood, 0 to 1; `mask` marks vessel pixels."""

    blood: Image
    mask: Mask


def draw(
    vessels: list[Vessel],
    shape: tuple[int, int],
    px_per_deg: float,
    at: Callable[[float, float], tuple[float, float]],
    reflex: float = 0.0,
) -> Strokes:
    """Return the vessels rasterised on a canvas of `shape` (rows, cols).

    `at` maps (x, y) in degrees to (row, col). `reflex`, 0 to 1, is the strength of the bright central line of these
    vessels; the caller sets it for arteries.
    """
    edge = np.full(shape, FAR)
    axis = np.full(shape, FAR)
    origin = at(0.0, 0.0)
    for vessel in vessels:
        _update_distances(edge, axis, _stroke_discs(vessel, px_per_deg, origin))
    radius = np.maximum(axis - edge, np.float32(0.05))
    near = axis < radius + 1
    thin = np.minimum(1, 2 * radius) / np.minimum(1, radius + 0.5)  # less than a pixel wide
    cover = np.where(near, np.clip(0.5 - edge, 0, 1) * thin, 0)
    across = np.minimum(axis / (radius + 0.5), 1)
    depth = 0.3 + 0.7 * (1 - across**2) ** 0.4
    width_deg = 2 * radius / np.float32(px_per_deg)
    strength = np.clip(width_deg / FULL_WIDTH_DEG, 0.05, 1) ** 0.45
    shine = reflex * np.clip(width_deg / 0.25, 0, 1) ** 2 * np.exp(-((across / 0.33) ** 2))
    blood: Image = (cover * depth * strength * (1 - shine)).astype(np.float32)
    return Strokes(blood, near & ((edge < 0) | (axis < 0.6)))


def _stroke_discs(vessel: Vessel, px_per_deg: float, origin: tuple[float, float]) -> NDArray[np.float32]:
    """Return the discs along a vessel, (n, 3) of row, col and radius in px, evenly spaced."""
    row = origin[0] + vessel.points[:, 1] * px_per_deg
    col = origin[1] + vessel.points[:, 0] * px_per_deg
    radius = vessel.points[:, 2] * px_per_deg / 2
    along = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(row), np.diff(col)))))
    places = np.arange(0, along[-1], SPACING_PX)
    return np.stack([np.interp(places, along, values) for values in (row, col, radius)], 1).astype(np.float32)


def _update_distances(edge: Image, axis: Image, dabs: NDArray[np.float32]) -> None:
    """Lower, in place, the px distances to the nearest edge (negative inside) and centre of the discs `dabs`."""
    reach = int(np.ceil(dabs[:, 2].max() + 2))
    around = np.arange(-reach, reach + 1)
    rows = np.rint(dabs[:, 0]).astype(np.intp)[:, None, None] + around[None, :, None]
    cols = np.rint(dabs[:, 1]).astype(np.intp)[:, None, None] + around[None, None, :]
    away = np.hypot(rows - dabs[:, 0, None, None], cols - dabs[:, 1, None, None]).astype(np.float32)
    inside = (rows >= 0) & (rows < edge.shape[0]) & (cols >= 0) & (cols < edge.shape[1])
    flat = (rows * edge.shape[1] + cols)[inside]
    np.minimum.at(axis.reshape(-1), flat, away[inside])
    np.minimum.at(edge.reshape(-1), flat, (away - dabs[:, 2, None, None])[inside])
