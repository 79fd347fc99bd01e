"""Record of the simulator: digests of every shipped scene's frames and PSFs, with its plan."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from device.config.head_file import load_head
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from tests.golden import compare
from tests.simulated import SCENES, coarse, exposed_counts, world

K = 4  # K x K pixels of the scene's sensor are combined in the simulated calibration


def names() -> list[str]:
    """Return the names of the shipped scenes, in order."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def record(name: str) -> dict[str, Any]:
    """Return digests of one scene: lit and dark counts, truth, noise-free PSF, its plan, its coarse calibration.

    Frames and PSF are at full size, as written by `diffuscope simulate`. Each digest has mean and maximum beside it:
    equal figures with another digest mean a difference in rounding.
    """
    spec = load_head(SCENES / f"{name}.toml")
    scene, colour = world(spec), spec.light.colour
    arrays = {
        "counts": exposed_counts(scene),
        "dark": exposed_counts(scene, lit=False),
        "truth": scene.truth(colour),
        "psf": crop_or_pad(scene.psf(colour), scene.shape),
    }
    calibration = simulated_calibration(world(coarse(spec, K)))
    plan = {
        one.name: {"simulated": one.simulated, "eta": float(f"{one.eta:.6g}"), "why": one.why} for one in scene.plan
    }
    digests = {key: digest(array) for key, array in arrays.items()}
    return digests | {"calibration_psf": digest(calibration.psfs[0].pixels), "plan": plan}


def digest(array: np.ndarray) -> dict[str, Any]:
    """Return shape, type, SHA-256 of the bytes, mean and maximum of an array."""
    return {
        "shape": list(array.shape), "dtype": str(array.dtype),
        "sha256": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest(),
        "mean": float(f"{array.mean(dtype=np.float64):.6g}"), "max": float(f"{array.max():.6g}"),
    }  # fmt: skip


def write() -> Path:
    """Write the record of all scenes."""
    compare.write("scenes", {name: record(name) for name in names()})
    return compare.RECORDS / "scenes.json"
