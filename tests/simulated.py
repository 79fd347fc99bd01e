"""Scenes for tests: coarser pixels with the same optics and light, changed keys, and frames of their worlds."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import decide
from device.sim.world import World
from device.values import Counts, ExposureSettings, Illumination

SCENES = Path(__file__).parents[1] / "device" / "sim" / "scenes"
PEDESTAL_DN = 1000.0  # so that no count is clipped at zero
SMALL_SCENE = """\
[sim]

[sim.object]
haemorrhages = 3
"""


def small_head_toml(name: str, tables: str = SMALL_SCENE, summed: int = 1, exposure_s: float | None = None) -> str:
    """Return the head file of a simulated head with a small sensor, 270 x 480 pixels, `summed` x `summed` as one.

    `tables` are its further tables; `exposure_s` is the exposure of pictures and of aiming, None: the default.
    """
    times = "" if exposure_s is None else f"exposure_s = {exposure_s}\npreview_exposure_s = {exposure_s}\n"
    return f"""\
name = "{name}"

[camera]
backend = "sim"
rows = {2 * -(-135 // summed)}
cols = {480 // summed}
pitch_um = {20.16 * summed:.2f}
full_well_e = 23000
read_noise_e = 1.03
{times}
[light]
backend = "sim"

[optics]
iris_um = 3200
diffuser_to_sensor_um = 6000
angular_magnification = 0.75
field_deg = 33.4

{tables}"""


def coarse(spec: InstrumentSpec, k: int) -> InstrumentSpec:
    """Return the head with k x k of its pixels summed: same light per area, same noise, same readout time."""
    camera, sim = spec.camera, spec.sim
    assert sim is not None
    summed = {
        "rows": camera.rows // k,
        "cols": camera.cols // k,
        "pitch_um": k * camera.pitch_um,
        "full_well_e": k**2 * camera.full_well_e,
        "read_noise_e": k * camera.read_noise_e,
        "bit_depth": min(camera.bit_depth + 2, 16),
    }
    flaws = {
        "dsnu_e": k * sim.sensor.dsnu_e,
        "column_noise_e": k**1.5 * sim.sensor.column_noise_e,
        "dark_e_per_s": k**2 * sim.sensor.dark_e_per_s,
        "line_s": k * sim.sensor.line_s,
    }
    head = spec.model_copy(update={"camera": camera.model_copy(update=summed)})
    peak_e = sim.peak_e if sim.peak_e == "budget" else k**2 * sim.peak_e  # a budget follows the pixels by itself
    return with_keys(head, peak_e=peak_e, sensor=flaws)


def with_keys(spec: InstrumentSpec, **keys: Any) -> InstrumentSpec:
    """Return the head with other keys in [sim]; a dictionary changes keys of that table."""
    sim = spec.sim
    changed = {k: getattr(sim, k).model_copy(update=v) if isinstance(v, dict) else v for k, v in keys.items()}
    return spec.model_copy(update={"sim": sim.model_copy(update=changed)})


def world(spec: InstrumentSpec, **chosen: Any) -> World:
    """Return a world whose effects `decide` selects with these arguments."""
    return World(spec, VirtualClock(), choose=partial(decide, **chosen))


def exposed_counts(of: World, lit: bool = True) -> Counts:
    """Return one lit frame, or a dark one."""
    camera, light = SimCamera(of), SimLight(of)
    if not lit:
        return camera.expose(ExposureSettings(of.spec.camera.exposure_s)).counts
    with light.on(Illumination(of.spec.light.colour)):
        return camera.expose(ExposureSettings(of.spec.camera.exposure_s)).counts


def expected_electrons(of: World) -> NDArray[np.float64]:
    """Return the noise-free electrons of a frame after the sensor's response, without rounding."""
    with SimLight(of).on(Illumination(of.spec.light.colour)):
        arriving = of.electrons(of.spec.camera.exposure_s)
    gain = of.scene.peak_e / 40000
    reader = replace(of.sensor, shot=False, read_noise_e=0.0, gain_e_per_dn=gain, black_dn=PEDESTAL_DN, white_dn=65535)
    return gain * (reader.read(arriving, 0).astype(np.float64) - PEDESTAL_DN)
