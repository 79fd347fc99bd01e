"""Pixels that respond unequally (optics.md 3.9, PRNU): a fixed pattern that a flat frame takes out."""

from math import sqrt

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "prnu"


def size(scene: Scene) -> Size:
    """White, and so a noise of its own: spread x signal, against sqrt(signal), is the most where it is brightest."""
    spread = scene.sim.sensor.prnu
    return Size(spread * sqrt(scene.peak_e), f"{spread:.2%} from pixel to pixel")


def apply(setup: Setup) -> None:
    """A pattern of this sensor's own."""
    draw = np.random.default_rng((setup.scene.seed, 31)).standard_normal(setup.shape, dtype=np.float32)
    setup.respond(np.maximum(1 + np.float32(setup.scene.sim.sensor.prnu) * draw, 0))
