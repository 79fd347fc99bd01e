"""Illumination that weakens towards the field's edge: Lambert and the eye's cos^3 (optics.md 3.5); and vignetting."""

from math import cos, radians

import numpy as np
from numpy.typing import NDArray

from device.sim.setup import Scene, Setup, Size

name = "falloff"

ETA = 7.0  # at 33.4 degrees on a sensor that the field fills, where the edge keeps 0.84 of the light
TABLE_LOSS = 1 - cos(radians(16.7)) ** 4


def share(scene: Scene, angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of the middle's light that is left at an angle from the axis."""
    light = scene.sim.light
    left = np.cos(np.radians(np.minimum(angle_deg, 85))) ** 4 if light.falloff else np.ones_like(angle_deg)
    if light.vignette_deg is not None:
        left = left * np.exp(-((angle_deg / light.vignette_deg) ** 2))
    return np.asarray(left)


def size(scene: Scene) -> Size:
    """In proportion to what the edge loses."""
    loss = 1 - float(share(scene, np.array(scene.half_field_deg)))
    if not loss:
        return Size(0.0, "the illumination is even")
    return Size(ETA * loss / TABLE_LOSS * scene.weight, f"the field's edge gets {1 - loss:.2f} of the middle's light")


def apply(setup: Setup) -> None:
    """Darken the object towards its edge."""
    rows, cols = (np.arange(n) - (n - 1) / 2 for n in setup.object.shape)
    angle_deg = np.hypot(rows[:, None], cols[None, :]) / setup.scene.geometry.px_per_deg
    setup.object = (setup.object * share(setup.scene, angle_deg)).astype(np.float32)
