"""Whole counts: what the converter rounds away (optics.md 3.1)."""

from math import sqrt

from device.sim.setup import Scene, Setup, Size

name = "quantisation"


def size(scene: Scene) -> Size:
    """White noise of a twelfth of a step squared. Little, but files hold whole counts anyway."""
    eta = scene.spec.camera.gain_e_per_dn / sqrt(12) / scene.noise_e
    return Size(max(eta, 0.05), f"{scene.spec.camera.bit_depth} bit: {eta:.3f} of the noise; files hold whole counts")


def apply(setup: Setup) -> None:
    """The converter rounds; there is nothing to add."""
