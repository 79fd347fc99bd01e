"""Whole counts: what the converter rounds away (optics.md 3.1)."""

from math import hypot, sqrt

from device.sim.setup import Scene, Setup, Size

name = "quantisation"


def size(scene: Scene) -> Size:
    """White noise of a twelfth of a step squared: little in the light, but the dark frame shows it."""
    camera = scene.spec.camera
    rounding_e = camera.gain_e_per_dn / sqrt(12)
    why = f"{camera.bit_depth} bit: {rounding_e:.1f} electrons are rounded away, of the noise that a dark frame has"
    return Size(rounding_e / hypot(rounding_e, camera.read_noise_e), why)


def apply(setup: Setup) -> None:
    """The converter rounds; there is nothing to add."""
