"""An eye that drifts during the exposure (optics.md 3.10): the image is smeared along the way."""

from device.sim.setup import Scene, Setup, Size

name = "motion"

ETA_PER_DEG2 = 2.25


def size(scene: Scene) -> Size:
    """With the square of the way."""
    way_deg = scene.sim.eye.drift_deg_per_s * scene.spec.camera.exposure_s
    return Size(ETA_PER_DEG2 * way_deg**2 * scene.weight, f"{way_deg:.3f} deg in one exposure")


def apply(setup: Setup) -> None:
    """To the right, evenly."""
    scene = setup.scene
    way_deg = scene.sim.eye.drift_deg_per_s * scene.spec.camera.exposure_s
    setup.drift_px = (way_deg * scene.geometry.px_per_deg, 0.0)
