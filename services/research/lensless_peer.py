"""LenslessPiCam's ADMM with its authors' settings, as a program of its own environment, without this project.

Their loader scales the PSF to unit L2 norm and the data to a maximum of 1; so does this program. argv: a folder. For
each line on standard input it reads `in.npz` of that folder, writes the pictures as `0.npy` and so on, and answers with
one line of JSON: rounds, milliseconds and peak memory of each picture, and the version.
"""

import json
import sys
import time
import tracemalloc
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lensless.recon.admm import ADMM


def planned(psf: np.ndarray, data: np.ndarray) -> ADMM:
    """Return their solver for a PSF and data, both (1, rows, cols, channels)."""
    solver = ADMM(psf)
    solver.set_data(data)
    return solver


def peak_mb(psf: np.ndarray, data: np.ndarray) -> float:
    """Return the peak memory of planning and one round in MB."""
    tracemalloc.start()
    planned(psf, data).apply(n_iter=1, disp_iter=None, plot=False)
    mb = tracemalloc.get_traced_memory()[1] / 2**20
    tracemalloc.stop()
    return mb


def solve(folder: Path) -> list[dict[str, float | str | None]]:
    """Solve `in.npz` with each number of rounds; planning is not timed."""
    with np.load(folder / "in.npz") as given:
        y = given["y"]
        psf = given["psf"]
        every = given["rounds"]
        measured = bool(given["memory"])
    psf = np.maximum(psf, 0)
    channels = np.atleast_3d(y)
    spread = np.repeat(np.atleast_3d(psf / np.linalg.norm(psf)), channels.shape[2], axis=2)
    spread = spread.astype(np.float32)[None]
    data = (np.maximum(channels, 0) / y.max()).astype(np.float32)[None]
    mb = peak_mb(spread, data) if measured else None
    solver = planned(spread, data)
    found: list[dict[str, float | str | None]] = []
    for k, rounds in enumerate(every):
        begin = time.perf_counter()
        picture = solver.apply(n_iter=int(rounds), disp_iter=None, plot=False)
        ms = (time.perf_counter() - begin) * 1e3
        np.save(folder / f"{k}.npy", np.asarray(picture, np.float32).reshape(y.shape))
        found.append({"rounds": int(rounds), "ms": ms, "mb": mb, "version": version("lensless")})
    return found


def main(folder: Path) -> None:
    """Answer every line of standard input, until it ends."""
    for _ in sys.stdin:
        sys.stdout.write(json.dumps(solve(folder)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
