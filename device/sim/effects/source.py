"""The calibration's point is a dot of some size (optics.md 2.1, 3.1)."""

from device.sim.setup import Scene, Setup, Size

name = "source"

TABLE_ETA, TABLE_UM, POWER = 0.89, 275.0, 1.4  # .08, .21, .89 for 50, 100, 275 um


def size(scene: Scene) -> Size:
    """With a power of its diameter."""
    dot_um = scene.sim.calibration.source_um
    return Size(
        TABLE_ETA * (dot_um / TABLE_UM) ** POWER * scene.weight, f"a dot of {dot_um:.0f} um stands for the point"
    )


def apply(setup: Setup) -> None:
    """For the calibration only: in a frame, an object's size is its own."""
    setup.source_um = setup.scene.sim.calibration.source_um
