"""One simulated exposure with its ground truth, in memory or as files with the plan of its effects."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec
from device.config.marked_files import png_bytes, tiff_bytes, write_npy
from device.errors import SettingError, StoreError
from device.sim.camera import SimCamera
from device.sim.eyes import EffectSelector
from device.sim.light import SimLight
from device.sim.plan import Decision, decide
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Counts, ExposureSettings, Illumination, Image, Mask

MAX_FRAMES = 64  # of one burst


@dataclass(frozen=True)
class SimulatedExposure:
    """One exposure of a simulated head with its ground truth, all (rows, cols) of its sensor.

    `truth` is the reflectance of the object; `vessels` is its vessel mask, None if not known.
    """

    counts: Counts
    truth: Image
    vessels: Mask | None
    calibration: Calibration


def simulate_exposure(spec: InstrumentSpec, choose: EffectSelector = decide) -> SimulatedExposure:
    """Return a lit frame in the picture's colour with ground truth; SpecError for a spec without [optics] or [sim]."""
    world = World(spec, VirtualClock(), choose=choose)
    colour = spec.light.colour
    (counts,) = lit_frames(world)
    mask = world.retina.vessels
    vessels = None if mask is None else crop_or_pad(mask.astype(np.float32), world.shape) > 0.5
    return SimulatedExposure(counts, world.truth(colour), vessels, simulated_calibration(world))


def simulate(spec: InstrumentSpec, folder: Path, choose: EffectSelector = decide, count: int = 1) -> World:
    """Expose `count` lit frames in the picture's colour, write them with their truth, and return their simulated world.

    Files and StoreError as in `write`. SpecError for a spec without [optics] or [sim].
    """
    world, frames = expose(spec, choose, count)
    write(world, frames, folder)
    return world


def expose(spec: InstrumentSpec, choose: EffectSelector = decide, count: int = 1) -> tuple[World, tuple[Counts, ...]]:
    """Return the simulated world of a scene, and `count` lit frames in the picture's colour: counts, (rows, cols).

    The frames are one burst: one diffuser and one eye, which moves as the scene says, each with noise of its own.
    SpecError for a spec without [optics] or [sim], SettingError for a count outside 1 to MAX_FRAMES.
    """
    if not 1 <= count <= MAX_FRAMES:
        raise SettingError(f"{count} frames cannot be simulated at once", f"Give 1 to {MAX_FRAMES} frames.")
    world = World(spec, VirtualClock(), choose=choose)
    return world, lit_frames(world, count)


def lit_frames(world: World, count: int = 1) -> tuple[Counts, ...]:
    """Return frames of a scene in one light of the picture's colour, (rows, cols) each: no head and no ring is opened.

    The light is traced before it is lit.
    """
    spec = world.spec
    camera = SimCamera(world)
    world.electrons_per_s(spec.light.colour)
    with SimLight(world).on(Illumination(spec.light.colour)):
        return tuple(camera.expose(ExposureSettings(spec.camera.exposure_s)).counts for _ in range(count))


def write(world: World, frames: Sequence[Counts], folder: Path) -> None:
    """Write the frames of a simulated world with their ground truth, which is that of the first frame.

    Files: raw.tiff and, of further frames, raw-2.tiff and so on, uint16; truth.npy (reflectance) and psf.tiff
    (noise-free PSF of this eye), float32 on the sensor grid (rows, cols); vessels.png if the vessels are known;
    plan.json. The pictures are marked as simulated. StoreError if the folder cannot be written.
    """
    colour = world.spec.light.colour
    plan = plan_as_json(world.plan, world.setup(colour).spent_ms)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, counts in enumerate(frames, 1):
            name = "raw.tiff" if number == 1 else f"raw-{number}.tiff"
            (folder / name).write_bytes(tiff_bytes(counts, True))
        write_npy(folder / "truth.npy", world.truth(colour), True)
        (folder / "psf.tiff").write_bytes(tiff_bytes(crop_or_pad(world.psf(colour), world.shape), True))
        _write_vessels(world, folder / "vessels.png")
        (folder / "plan.json").write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{folder} cannot be written: {error}", "Give a folder that can be written.") from error


def plan_as_json(plan: tuple[Decision, ...], spent_ms: dict[str, float]) -> dict[str, dict[str, Any]]:
    """Return by effect name: simulated or not, eta, the text that explains eta, and the computing time in ms."""
    return {
        decision.name: {
            "simulated": decision.simulated,
            "eta": decision.eta,
            "why": decision.why,
            "cost_ms": round(spent_ms.get(decision.name, 0.0), 1) if decision.simulated else 0.0,
        }
        for decision in plan
    }


def _write_vessels(world: World, path: Path) -> None:
    """Write the vessel mask on the sensor grid as a PNG of 0 and 255; nothing if the vessels are not known."""
    mask = world.retina.vessels
    if mask is not None:
        on_sensor = crop_or_pad(mask.astype(np.float32), world.shape) > 0
        path.write_bytes(png_bytes(on_sensor.astype(np.uint8) * 255, True, for_eyes=False))
