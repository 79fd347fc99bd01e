"""One simulated exposure as files, with the truth beside it and a plan: what was simulated, and what was left out."""

import json
import math
from pathlib import Path
from typing import TypedDict

import numpy as np
import tifffile
from PIL import Image as Pictures

from device.clock import VirtualClock
from device.errors import StoreError
from device.optics.diffuser import EMMETROPIA, Refraction
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.world import World, fitted
from device.spec import InstrumentSpec, OpticsSpec
from device.values import Glow, Image, Shot

DRIFT_DEG_PER_S = 0.9  # of a fixating eye, at most (optics.md 3.10)
LINES = 3


class Effect(TypedDict):
    """Whether one effect is in the frame, why, and the number that decided."""

    simulated: bool
    why: str
    number: float


def simulate(spec: InstrumentSpec, folder: Path, refraction: Refraction = EMMETROPIA) -> dict[str, Effect]:
    """Expose one frame under the picture's lamp and write it with its truth; returns the plan.

    raw.tiff uint16; truth.npy and psf.tiff float32 on the sensor grid (rows, cols), the PSF without noise, of this eye;
    vessels.png if the vessels are known; plan.json. Raises SpecError for a spec without [optics] and [sim], StoreError
    if the folder cannot be written.
    """
    world = World(spec, VirtualClock(), refraction=refraction)
    colour, shot = spec.light.colour, Shot(spec.camera.exposure_s)
    with SimLight(world).on(Glow(colour)):
        electrons = world.electrons(shot.exposure_s)
        counts = SimCamera(world).expose(shot).counts
    plan = {**effects(world, electrons, float((counts >= spec.camera.white_dn).mean())), **left_out(world)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / "raw.tiff", counts, description=json.dumps({"simulated": True}))
        np.save(folder / "truth.npy", world.truth(colour))
        tifffile.imwrite(folder / "psf.tiff", fitted(world.psf(colour), world.shape))
        _write_vessels(world, folder / "vessels.png")
        (folder / "plan.json").write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{folder} cannot be written: {error}", "Give a folder that can be written.") from error
    return plan


def effects(world: World, electrons: Image, saturated: float) -> dict[str, Effect]:
    """What is in the frame: each effect with its size, computed for this scene."""
    camera, optics = world.spec.camera, world.optics
    peak_e = float(electrons.max())
    mean_e = float(electrons[electrons > 0.05 * peak_e].mean()) if peak_e > 0 else 0.0
    rounding_e2 = camera.gain_e_per_dn**2 / 12
    noise_e2 = max(mean_e + camera.read_noise_e**2 + rounding_e2, 1e-30)
    edge_um = edge_shift_um(optics, world.refraction)
    captured = captured_fraction(world)
    return {
        "refraction": _effect(edge_um != 0, f"the iris edge moves {edge_um:.1f} um on the sensor", edge_um),
        "bandwidth": _effect(True, f"the caustic is the sum of {LINES} wavelengths", float(LINES)),
        "shot_noise": _effect(True, f"its share of the variance at {mean_e:.0f} electrons", mean_e / noise_e2),
        "read_noise": _effect(camera.read_noise_e > 0, "its share of the variance", camera.read_noise_e**2 / noise_e2),
        "quantisation": _effect(True, f"{camera.bit_depth} bit; its share of the variance", rounding_e2 / noise_e2),
        "saturation": _effect(
            True, f"the share of pixels at the end of the converter, peak {peak_e:.0f} e-", saturated
        ),
        "crop": _effect(
            captured < 1, "the share of a field-edge point's light that the sensor catches, short axis", captured
        ),
    }


def left_out(world: World) -> dict[str, Effect]:
    """What is not in the frame, and the number that says whether it matters."""
    drift_deg = DRIFT_DEG_PER_S * world.spec.camera.exposure_s
    return {
        "motion": _effect(
            False, "drift in one exposure, degrees; up to 0.15 it changes the picture by 0.05 of its noise", drift_deg
        ),
        "pixel_response": _effect(
            False, "not modelled; 0.1 % uncorrected changes the picture by 0.23 of its noise (optics.md 3.1)", 0.23
        ),
        "reflexes": _effect(False, "not modelled; crossed polarisers are taken as perfect", 0.0),
    }


def edge_shift_um(optics: OpticsSpec, refraction: Refraction) -> float:
    """How far a refractive error moves the caustic at the iris edge, in its worst meridian; optics.md 2.4."""
    stretch = refraction.warp(optics) - np.eye(2)
    return float(np.abs(np.linalg.eigvalsh(stretch)).max()) * optics.iris_um / 2


def captured_fraction(world: World) -> float:
    """The share of the iris shadow of a point at the field's edge that falls on the sensor's short side.

    optics.md 1.5: c = 1 - (acos u - u sqrt(1 - u^2)) / pi, u = (D/2 - s) / (d/2), s = a f_d theta / 2.
    """
    optics = world.optics
    half_um = min(world.shape) * world.geometry.pitch_um / 2
    shift_um = optics.angular_magnification * optics.diffuser_to_sensor_um * math.radians(optics.field_deg) / 2
    u = max(-1.0, min(1.0, (half_um - shift_um) / (optics.iris_um / 2)))
    return 1 - (math.acos(u) - u * math.sqrt(1 - u * u)) / math.pi


def _effect(simulated: bool, why: str, number: float) -> Effect:
    return {"simulated": bool(simulated), "why": why, "number": float(number)}


def _write_vessels(world: World, path: Path) -> None:
    """The vessel mask on the sensor grid, where the vessels are known."""
    mask = world.retina.vessels
    if mask is not None:
        on_sensor = fitted(mask.astype(np.float32), world.shape) > 0
        Pictures.fromarray(on_sensor.astype(np.uint8) * 255).save(path)
