"""A scene as whoever judges pictures wants it: the counts, the truth beside them, and the head's calibration."""

from dataclasses import dataclass

import numpy as np

from device.clock import VirtualClock
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.render import fitted
from device.sim.world import World
from device.spec import InstrumentSpec
from device.values import Calibration, Counts, Glow, Image, Mask, Shot


@dataclass(frozen=True)
class Staged:
    """One exposure of a simulated head, (rows, cols) of its sensor; `vessels` is None where they are not known."""

    counts: Counts
    truth: Image
    vessels: Mask | None
    calibration: Calibration


def staged(spec: InstrumentSpec) -> Staged:
    """Expose one frame under the picture's lamp; SpecError for a spec without [optics] and [sim]."""
    world = World(spec, VirtualClock())
    colour = spec.light.colour
    world.electrons_per_s(colour)  # now, not while the lamp is lit
    with SimLight(world).on(Glow(colour)):
        counts = SimCamera(world).expose(Shot(spec.camera.exposure_s)).counts
    mask = world.retina.vessels
    vessels = None if mask is None else fitted(mask.astype(np.float32), world.shape) > 0.5
    return Staged(counts, world.truth(colour), vessels, simulated_calibration(world))
