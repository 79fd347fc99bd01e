"""Pixels that respond unequally (optics.md 3.9, PRNU): a fixed pattern that a flat frame takes out."""

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "prnu"

ETA_PER_SHARE = 230.0  # 0.23 per 0.1 %, uncorrected


def size(scene: Scene) -> Size:
    """In proportion to its spread."""
    spread = scene.sim.sensor.prnu
    return Size(ETA_PER_SHARE * spread * scene.weight, f"{spread:.2%} from pixel to pixel")


def apply(setup: Setup) -> None:
    """A pattern of this sensor's own."""
    draw = np.random.default_rng((setup.scene.seed, 31)).standard_normal(setup.shape, dtype=np.float32)
    setup.respond(np.maximum(1 + np.float32(setup.scene.sim.sensor.prnu) * draw, 0))
