"""A colour filter mosaic under one colour of light: most pixels see little of it (optics.md 1.5)."""

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "bayer"

LEAK = 0.1  # what a filter of another colour lets through
SITES = {"red": ((0, 0),), "green": ((0, 1), (1, 0)), "blue": ((1, 1),)}  # RGGB


def size(scene: Scene) -> Size:
    """Nothing on a monochrome sensor; on a mosaic it is no small change."""
    return Size(20.0 * scene.weight, "RGGB") if scene.sim.sensor.bayer else Size(0.0, "the sensor is monochrome")


def apply(setup: Setup) -> None:
    """The response of each pixel behind its filter."""
    if not setup.scene.sim.sensor.bayer:
        return
    response = np.full(setup.shape, LEAK, np.float32)
    for row, col in SITES[setup.scene.colour]:
        response[row::2, col::2] = 1
    setup.respond(response)
