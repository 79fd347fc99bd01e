"""Record of the simulator: figures of every shipped scene's frames and PSFs, with its plan."""

from pathlib import Path
from typing import Any

import numpy as np

from device.config.head_file import load_head
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from tests.golden import compare
from tests.simulated import SCENES, coarse, exposed_counts, world

K = 4  # K x K pixels of the scene's sensor are combined in the simulated calibration
BLOCKS = 4  # along each axis
TOLERANCE = 1e-3  # one count more or less where a value is rounded; 4e-4 was seen between two processors
SAMPLE = ("colour_sensor", "crowded_imx296", "diabetic", "drifting_eye", "healthy", "human_eye_imx477", "worn_sensor")


def names() -> list[str]:
    """Return the names of the shipped scenes, in order."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def record(name: str) -> dict[str, Any]:
    """Return figures of one scene: lit and dark counts, truth, noise-free PSF, its plan, its coarse calibration.

    Frames and PSF are at full size, as written by `diffuscope simulate`.
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
        effect.name: {"simulated": effect.simulated, "eta": float(f"{effect.eta:.6g}"), "why": effect.why}
        for effect in scene.plan
    }
    seen = {key: figures(np.asarray(array)) for key, array in arrays.items()}
    return seen | {"calibration_psf": figures(calibration.psfs[0].pixels), "plan": plan}


def difference(name: str) -> str:
    """Return the difference of one scene from its record beyond the tolerance; "" without one."""
    return compare.difference(compare.read("scenes")[name], record(name), TOLERANCE)


def figures(array: np.ndarray) -> dict[str, Any]:
    """Return shape, type and maximum of an array; relative to its mean its maximum, sd, and means of 4 x 4 blocks.

    A digest would differ from processor to processor, with the order of sums in an FFT.
    """
    values = array.astype(np.float64)
    values /= values.mean()
    bands = [block for band in np.array_split(values, BLOCKS) for block in np.array_split(band, BLOCKS, axis=1)]
    return {
        "shape": list(array.shape),
        "dtype": str(array.dtype),
        "max": _rounded(array.max()),
        "max_to_mean": _rounded(values.max()),
        "sd_to_mean": _rounded(values.std()),
        "blocks_to_mean": [_rounded(block.mean()) for block in bands],
    }


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def write() -> Path:
    """Write the record of all scenes."""
    compare.write("scenes", {name: record(name) for name in names()})
    return compare.RECORDS / "scenes.json"
