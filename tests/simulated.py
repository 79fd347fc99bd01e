"""Scenes for tests: coarser pixels with the same optics and light, other keys, and what a world then gives."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import decide
from device.sim.world import World
from device.spec import InstrumentSpec
from device.values import Counts, Glow, Shot

SCENES = Path(__file__).parents[1] / "device" / "sim" / "scenes"
PEDESTAL_DN = 1000.0  # so that nothing is cut off below zero


def coarse(spec: InstrumentSpec, k: int) -> InstrumentSpec:
    """The head as if k x k of its pixels had been summed: as much light per area, as much noise, as fast a shutter."""
    camera, sim = spec.camera, spec.sim
    assert sim is not None
    summed = {
        "rows": camera.rows // k, "cols": camera.cols // k, "pitch_um": k * camera.pitch_um,
        "full_well_e": k**2 * camera.full_well_e, "read_noise_e": k * camera.read_noise_e,
        "bit_depth": min(camera.bit_depth + 2, 16),
    }  # fmt: skip
    flaws = {
        "dsnu_e": k * sim.sensor.dsnu_e, "dark_e_per_s": k**2 * sim.sensor.dark_e_per_s,
        "line_s": k * sim.sensor.line_s,
    }  # fmt: skip
    head = spec.model_copy(update={"camera": camera.model_copy(update=summed)})
    return having(head, peak_e=k**2 * sim.peak_e, sensor=flaws)


def having(spec: InstrumentSpec, **keys: Any) -> InstrumentSpec:
    """The head with other keys in [sim]; a dictionary changes keys of that table."""
    sim = spec.sim
    changed = {k: getattr(sim, k).model_copy(update=v) if isinstance(v, dict) else v for k, v in keys.items()}
    return spec.model_copy(update={"sim": sim.model_copy(update=changed)})


def world(spec: InstrumentSpec, **chosen: Any) -> World:
    """A world with those effects that `decide` is told to choose."""
    return World(spec, VirtualClock(), choose=partial(decide, **chosen))


def exposed(of: World, lit: bool = True) -> Counts:
    """One frame, or a dark one."""
    camera, light = SimCamera(of), SimLight(of)
    if not lit:
        return camera.expose(Shot(of.spec.camera.exposure_s)).counts
    with light.on(Glow(of.spec.light.colour)):
        return camera.expose(Shot(of.spec.camera.exposure_s)).counts


def expected(of: World) -> NDArray[np.float64]:
    """The electrons of a frame without noise, after all that the sensor does to them but round."""
    with SimLight(of).on(Glow(of.spec.light.colour)):
        arriving = of.electrons(of.spec.camera.exposure_s)
    gain = of.scene.peak_e / 40000
    reader = replace(
        of.sensor, shot=False, read_noise_e=0.0, gain_e_per_dn=gain, black_dn=PEDESTAL_DN, white_dn=65535
    )  # fmt: skip
    return gain * (reader.read(arriving, 0).astype(np.float64) - PEDESTAL_DN)
