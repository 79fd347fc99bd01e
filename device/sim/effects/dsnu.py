"""Pixels whose zero differs (DSNU): a fixed pattern that a dark frame takes out (optics.md 3.9)."""

import numpy as np

from device.sim.setup import Scene, Setup, Size

name = "dsnu"


def size(scene: Scene) -> Size:
    """White over the frame, so it weighs as noise of its spread does."""
    spread_e = scene.sim.sensor.dsnu_e
    return Size(spread_e / scene.noise_e, f"{spread_e:.1f} electrons from pixel to pixel")


def apply(setup: Setup) -> None:
    """A pattern of this sensor's own."""
    draw = np.random.default_rng((setup.scene.seed, 37)).standard_normal(setup.shape, dtype=np.float32)
    setup.sensor = setup.sensor.offset_by(np.float32(setup.scene.sim.sensor.dsnu_e) * draw)
