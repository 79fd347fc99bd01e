"""Light of the room, which comes without the lamp (optics.md 3.1, constant stray)."""

from device.sim.effects.stray import ETA_PER_SHARE
from device.sim.setup import Scene, Setup, Size

name = "ambient"


def size(scene: Scene) -> Size:
    """By its share of the mean signal; a dark frame takes the mean away, and leaves its noise."""
    share = scene.sim.light.ambient
    return Size(ETA_PER_SHARE * share * scene.weight, f"{share:.2%} of the mean signal")


def apply(setup: Setup) -> None:
    """A constant on every pixel, always."""
    setup.ambient = setup.scene.sim.light.ambient
