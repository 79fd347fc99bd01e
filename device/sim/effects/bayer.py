"""A colour filter mosaic under one colour of light: most pixels see little of it (optics.md 1.5)."""

from math import sqrt

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "bayer"

LEAK = 0.1  # what a filter of another colour lets through
SITES = {"red": ((0, 0),), "green": ((0, 1), (1, 0)), "blue": ((1, 1),)}  # RGGB


def size(scene: Scene) -> Size:
    """Nothing on a monochrome sensor; a mosaic keeps light away, and what is left is noisier by as much."""
    if not scene.sim.sensor.bayer:
        return Size(0.0, "the sensor is monochrome")
    kept = LEAK + (1 - LEAK) * len(SITES[scene.colour]) / 4
    return Size(sqrt(1 / kept - 1), f"the mosaic lets {kept:.0%} of {scene.colour} light through")


def apply(setup: Setup) -> None:
    """The response of each pixel behind its filter."""
    if not setup.scene.sim.sensor.bayer:
        return
    response = np.full(setup.shape, LEAK, np.float32)
    for row, col in SITES[setup.scene.colour]:
        response[row::2, col::2] = 1
    setup.respond(response)
