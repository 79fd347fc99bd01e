"""Hot pixels: full, whatever they see (optics.md 5.4)."""

from math import sqrt

import numpy as np

from device.sim.setup import Scene, Setup, Size
from device.values import Mask

name = "hot"


def size(scene: Scene) -> Size:
    """Each is wrong by up to a full well."""
    share, camera = scene.sim.sensor.hot_pixels, scene.spec.camera
    error_e = camera.full_well_e * sqrt(share)
    return Size(error_e / scene.noise_e, f"{share * camera.rows * camera.cols:.0f} pixels are full")


def hot_pixels(scene: Scene) -> Mask:
    """Where they are, on the sensor."""
    shape = scene.spec.camera.rows, scene.spec.camera.cols
    return np.random.default_rng((scene.seed, 41)).random(shape) < scene.sim.sensor.hot_pixels


def apply(setup: Setup) -> None:
    """A full well in each of them."""
    full_e = np.float32(setup.scene.spec.camera.full_well_e)
    setup.sensor = setup.sensor.offset_by(hot_pixels(setup.scene) * full_e)
