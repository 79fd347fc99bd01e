"""Even light that comes with the lamp: scatter in lenses and walls (optics.md 3.1, constant stray)."""

from device.sim.setup import Scene, Setup, Size

name = "stray"

ETA_PER_SHARE = 320.0  # where no constant is fitted; a solver that fits one sees less


def size(scene: Scene) -> Size:
    """By its share of the mean signal."""
    share = scene.sim.light.stray
    return Size(ETA_PER_SHARE * share * scene.weight, f"{share:.2%} of the mean signal")


def apply(setup: Setup) -> None:
    """A constant on every pixel while the lamp shines."""
    setup.veils[name] = setup.scene.sim.light.stray
