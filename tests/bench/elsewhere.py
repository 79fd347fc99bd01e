"""Peers that live in an environment of their own, `.bench-venv`, which `make bench-peers` makes."""

import json
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from device.values import Image

PYTHON = Path(".bench-venv/bin/python")


@cache
def is_there() -> bool:
    """Whether it has been made; says so once if not."""
    if not PYTHON.exists():
        print("LenslessPiCam and ducc0 are left out: `make bench-peers` installs them into .bench-venv")
    return PYTHON.exists()


def peer(script: str, *words: str) -> Any:
    """What a script beside this file prints as JSON, run over there; None where it cannot run, and why."""
    if not is_there():
        return None
    done = subprocess.run(
        [PYTHON, Path(__file__).with_name(script), *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        print(f"{script} is left out, it ended with: {(done.stderr.splitlines() or ['nothing'])[-1]}")
        return None
    return json.loads(done.stdout.splitlines()[-1])


def lensless_pictures(y: Image, psf: Image, rounds: tuple[int, ...]) -> list[tuple[str, float, float, Image]]:
    """Name, milliseconds, peak MB and picture of LenslessPiCam's ADMM for each number of rounds; 1 or 3 channels."""
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "in.npz", y=y, psf=psf, rounds=rounds)
        found = peer("lensless_peer.py", folder) or []
        return [
            (f"LenslessPiCam {one['version']} ADMM, {one['rounds']} rounds", one["ms"], one["mb"],
             np.load(f"{folder}/{k}.npy"))
            for k, one in enumerate(found)
        ]  # fmt: skip
