"""A response that bends towards the full well (optics.md 3.1)."""

from dataclasses import replace

from device.sim.setup import Scene, Setup, Size

name = "nonlinearity"

ETA_PER_SHARE = 140.0


def size(scene: Scene) -> Size:
    """In proportion to the bend that the peak meets."""
    at_peak = scene.sim.sensor.nonlinearity * min(scene.peak_e / scene.spec.camera.full_well_e, 1)
    return Size(ETA_PER_SHARE * abs(at_peak) * scene.weight, f"{at_peak:.2%} at the peak")


def apply(setup: Setup) -> None:
    """A quadratic term."""
    setup.sensor = replace(setup.sensor, nonlinearity=setup.scene.sim.sensor.nonlinearity)
