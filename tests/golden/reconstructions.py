"""Record of the solvers: the picture of each method after fixed rounds, and the keys and values of its report."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.simulated_calibration import simulated_calibration
from device.values import Image, Reconstruction
from tests.golden import compare
from tests.simulated import SCENES, coarse, exposed_counts, world

K = 4  # K x K pixels of the scene's sensor are combined
ROUNDS = 6
LADDER = "default ladder"
FOLDER = compare.RECORDS / "reconstructions"
TIMED = ("seconds",)


def cases() -> Iterator[tuple[str, Reconstruction]]:
    """Yield name and reconstruction of every method and of the default schedule, without and with a saturated disc.

    The frame is the scene `healthy` with 4 x 4 pixels summed, (270, 480). FFTs are planned by estimate and run on one
    thread, and no deadline ends the rounds, so that equal code gives equal pictures. The saturated disc applies to the
    schedule only.
    """
    scene = world(coarse(load_head(SCENES / "healthy.toml"), K))
    calibration, counts = simulated_calibration(scene), exposed_counts(scene)
    shape, planner = (counts.shape[0], counts.shape[1]), Planner(None, effort="FFTW_ESTIMATE", threads=1)
    for name in METHODS:
        known = replace(calibration, field_deg=None) if name == "open" else calibration
        make = Reconstructor(known, shape, planner, VirtualClock(), (Recipe(name, 1),), timed=False)
        yield name, make(counts, rounds=ROUNDS, simulated=True)
    make = Reconstructor(calibration, shape, planner, VirtualClock(), timed=False)
    yield LADDER, make(counts, rounds=ROUNDS, simulated=True)
    rows, cols = np.indices(shape)
    disc = np.hypot(rows - 150, cols - 260) < 12
    white = np.where(disc, calibration.sensor.white_dn, counts).astype(counts.dtype)
    yield f"{LADDER}, saturated disc", make(white, rounds=ROUNDS, simulated=True)


def report(made: Reconstruction) -> dict[str, Any]:
    """Return the report of a reconstruction without times, its figures with five digits."""
    values = {key: value for key, value in asdict(made.report).items() if key not in TIMED}
    rounded: dict[str, Any] = _rounded(values)
    return rounded


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, float | np.floating):
        return float(f"{value:.5g}")
    return list(value) if isinstance(value, tuple) else value


def place(name: str) -> Path:
    """Return the file of one picture."""
    return FOLDER / f"{name.replace(',', '').replace(' ', '-')}.npz"


def picture(name: str) -> Image:
    """Return the recorded picture, (rows, cols) float32."""
    with np.load(place(name)) as kept:
        return np.asarray(kept["picture"], np.float32)


def write() -> Path:
    """Write the pictures and the reports."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    reports = {}
    for name, made in cases():
        np.savez_compressed(place(name), picture=made.picture)
        reports[name] = report(made)
    compare.write("reconstructions", reports)
    return FOLDER
