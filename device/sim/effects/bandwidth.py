"""The LED's bandwidth: the caustic is the sum over its wavelengths (optics.md 2.2)."""

from device.sim.setup import Scene, Setup, Size

name = "bandwidth"

ETA_PER_UM = 0.25  # over a lattice of dots; a retina shows a fifth of it
LINES = 3


def size(scene: Scene) -> Size:
    """A diffuser's slopes bend all colours of one LED alike: 0.01 for 40 nm."""
    wide_um = scene.optics.bandwidth_um
    return Size(ETA_PER_UM * wide_um * scene.weight, f"{1000 * wide_um:.0f} nm wide")


def apply(setup: Setup) -> None:
    """Three wavelengths instead of one."""
    setup.lines = LINES
