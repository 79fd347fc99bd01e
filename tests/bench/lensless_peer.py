"""Runs in `.bench-venv`, which knows nothing of this repository: LenslessPiCam's ADMM as its authors set it up.

Their loader scales the PSF to unit L2 norm and the data to a maximum of 1; so does this. argv: a folder with in.npz.
"""

import json
import sys
import time
import tracemalloc
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lensless.recon.admm import ADMM  # type: ignore[import-not-found]


def planned(psf: np.ndarray, data: np.ndarray) -> ADMM:
    solver = ADMM(psf)
    solver.set_data(data)
    return solver


def main(folder: Path) -> None:
    with np.load(folder / "in.npz") as given:
        y, psf, every = given["y"], given["psf"], given["rounds"]
    psf = np.maximum(psf, 0)
    channels = np.atleast_3d(y)
    spread = np.repeat(np.atleast_3d(psf / np.linalg.norm(psf)), channels.shape[2], axis=2)
    spread, data = spread.astype(np.float32)[None], (np.maximum(channels, 0) / y.max()).astype(np.float32)[None]
    tracemalloc.start()
    planned(spread, data).apply(n_iter=1, disp_iter=None, plot=False)
    mb = tracemalloc.get_traced_memory()[1] / 2**20
    tracemalloc.stop()
    solver, found = planned(spread, data), []
    for k, rounds in enumerate(every):
        begin = time.perf_counter()
        picture = solver.apply(n_iter=int(rounds), disp_iter=None, plot=False)
        ms = (time.perf_counter() - begin) * 1e3
        np.save(folder / f"{k}.npy", np.asarray(picture, np.float32).reshape(y.shape))
        found.append({"rounds": int(rounds), "ms": ms, "mb": mb, "version": version("lensless")})
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
