"""Shot noise: electrons are counted one by one (optics.md 3.9)."""

from dataclasses import replace

from device.sim.setup import Scene, Setup, Size

name = "shot"


def size(scene: Scene) -> Size:
    """It is the noise that all others are measured against."""
    share = 1 - (scene.spec.camera.read_noise_e / scene.noise_e) ** 2
    return Size(1.0, f"{share:.2%} of the variance, {scene.peak_e:.0f} electrons at the peak")


def apply(setup: Setup) -> None:
    """Poisson's law, pixel by pixel."""
    setup.sensor = replace(setup.sensor, shot=True)
