"""Illumination that weakens towards the field's edge: Lambert and the eye's cos^3 (optics.md 3.5)."""

from math import cos, radians

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "falloff"

ETA = 7.0  # at 33.4 degrees on a sensor that the field fills, where the edge keeps 0.84 of the light
TABLE_LOSS = 1 - cos(radians(16.7)) ** 4


def size(scene: Scene) -> Size:
    """In proportion to what the edge loses."""
    if not scene.sim.light.falloff:
        return Size(0.0, "the illumination is even")
    loss = 1 - cos(radians(scene.half_field_deg)) ** 4
    return Size(ETA * loss / TABLE_LOSS * scene.weight, f"the field's edge gets {1 - loss:.2f} of the middle's light")


def apply(setup: Setup) -> None:
    """Darken the object towards its edge."""
    if not setup.scene.sim.light.falloff:
        return
    rows, cols = (np.arange(n) - (n - 1) / 2 for n in setup.object.shape)
    angle_rad = np.radians(np.hypot(rows[:, None], cols[None, :]) / setup.scene.geometry.px_per_deg)
    setup.object = (setup.object * np.cos(np.minimum(angle_rad, 1.5)) ** 4).astype(np.float32)
