"""Refraction: defocus and cylinder of the eye stretch the caustic (optics.md 2.4, 3.2)."""

from math import hypot

from device.sim.setup import Scene, Setup, Size

name = "refraction"

ETA_PER_DPT = 3.0


def size(scene: Scene) -> Size:
    """In proportion to the blur strength, the root of the squares; z a^2 r is how far the caustic's edge moves."""
    m, j0, j45 = scene.refraction
    dpt = hypot(m, j0, j45)
    edge_um = dpt * scene.geometry.scale_per_dpt * scene.optics.iris_um / 2
    return Size(ETA_PER_DPT * dpt * scene.weight, f"{dpt:.2f} dpt move the caustic's edge by {edge_um:.1f} um")


def apply(setup: Setup) -> None:
    """The eye's wavefront at the iris."""
    setup.refraction = setup.scene.refraction
