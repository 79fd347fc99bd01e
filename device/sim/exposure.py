"""One simulated exposure as files, with the truth beside it and a plan: what was simulated, and what was left out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image as Pictures

from device.clock import VirtualClock
from device.errors import StoreError
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.plan import Decision, decide
from device.sim.render import fitted
from device.sim.world import Choice, World
from device.spec import InstrumentSpec
from device.values import Glow, Shot


def simulate(spec: InstrumentSpec, folder: Path, choose: Choice = decide) -> World:
    """Expose one frame under the picture's lamp and write it with its truth; returns the world that it was taken in.

    raw.tiff uint16; truth.npy and psf.tiff float32 on the sensor grid (rows, cols), the PSF without noise, of this eye;
    vessels.png if the vessels are known; plan.json. Raises SpecError for a spec without [optics] and [sim], StoreError
    if the folder cannot be written.
    """
    world = World(spec, VirtualClock(), choose=choose)
    colour, shot = spec.light.colour, Shot(spec.camera.exposure_s)
    with SimLight(world).on(Glow(colour)):
        counts = SimCamera(world).expose(shot).counts
    plan = as_json(world.plan, world.setup(colour).spent_ms)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / "raw.tiff", counts, description=json.dumps({"simulated": True}))
        np.save(folder / "truth.npy", world.truth(colour))
        tifffile.imwrite(folder / "psf.tiff", fitted(world.psf(colour), world.shape))
        _write_vessels(world, folder / "vessels.png")
        (folder / "plan.json").write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{folder} cannot be written: {error}", "Give a folder that can be written.") from error
    return world


def as_json(plan: tuple[Decision, ...], spent_ms: dict[str, float]) -> dict[str, dict[str, Any]]:
    """Each effect: whether it is in the frame, the eta that decided, why, and what it cost."""
    return {
        one.name: {
            "simulated": one.simulated, "eta": one.eta, "why": one.why,
            "cost_ms": round(spent_ms.get(one.name, 0.0), 1) if one.simulated else 0.0,
        }
        for one in plan
    }  # fmt: skip


def _write_vessels(world: World, path: Path) -> None:
    """The vessel mask on the sensor grid, where the vessels are known."""
    mask = world.retina.vessels
    if mask is not None:
        on_sensor = fitted(mask.astype(np.float32), world.shape) > 0
        Pictures.fromarray(on_sensor.astype(np.uint8) * 255).save(path)
