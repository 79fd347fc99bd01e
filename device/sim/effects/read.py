"""Read noise of the sensor (optics.md 3.9)."""

from dataclasses import replace

from device.sim.setup import Scene, Setup, Size

name = "read"


def size(scene: Scene) -> Size:
    """Little beside the shot noise of a bright pixel; measured against the dark frame, which is made of it."""
    read_e = scene.spec.camera.read_noise_e
    return Size(1.0 if read_e > 0 else 0.0, f"{read_e:.2f} electrons: all the noise that a dark frame has")


def apply(setup: Setup) -> None:
    """Gaussian, pixel by pixel."""
    setup.sensor = replace(setup.sensor, read_noise_e=setup.scene.spec.camera.read_noise_e)
