"""Dark current: electrons that come without light (optics.md 3.1)."""

from device.sim.effects.stray import ETA_PER_SHARE
from device.sim.setup import Scene, Setup, Size

name = "dark"


def size(scene: Scene) -> Size:
    """As even light of the same size: its mean, before a dark frame takes it away."""
    dark_e = scene.sim.sensor.dark_e_per_s * scene.spec.camera.exposure_s
    return Size(ETA_PER_SHARE * dark_e / scene.lit_e * scene.weight, f"{dark_e:.1f} electrons in one exposure")


def apply(setup: Setup) -> None:
    """So many electrons per second in every pixel."""
    setup.dark_e_per_s = setup.scene.sim.sensor.dark_e_per_s
