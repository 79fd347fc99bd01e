"""A rolling shutter: later rows see an eye that has moved on (optics.md 3.10)."""

from device.sim.setup import Scene, Setup, Size

name = "shutter"

ETA_PER_DEG = 12.0  # a skew moves vessels at the top and bottom edge against each other


def size(scene: Scene) -> Size:
    """By how far the last row is behind the first, in degrees; a global shutter and a still eye have none."""
    skew_deg = scene.sim.eye.drift_deg_per_s * scene.sim.sensor.line_s * scene.spec.camera.rows
    return Size(ETA_PER_DEG * skew_deg * scene.weight, f"{skew_deg:.3f} deg from the first row to the last")


def apply(setup: Setup) -> None:
    """Each row is read a little later than the one before."""
    scene = setup.scene
    setup.lag_px = scene.sim.eye.drift_deg_per_s * scene.sim.sensor.line_s * scene.geometry.px_per_deg
