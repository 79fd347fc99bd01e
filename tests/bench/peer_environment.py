"""Peers in a separate environment, `.bench-venv`, made by `make bench-peers`."""

import json
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

from device.errors import SettingError
from device.values import Image
from services.research.peers import ENVIRONMENT, LenslessPeer

PYTHON = ENVIRONMENT / "bin" / "python"


@cache
def is_there() -> bool:
    """Return whether the environment exists; print a hint once if not."""
    if not PYTHON.exists():
        print("LenslessPiCam and ducc0 are left out: `make bench-peers` installs them into .bench-venv")
    return PYTHON.exists()


def peer(script: str, *words: str) -> Any:
    """Run a script of this folder in that environment.

    Return its JSON output, or None with a printed reason on failure.
    """
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
    """Return name, milliseconds, peak MB and picture of LenslessPiCam's ADMM per number of rounds; 1 or 3 channels."""
    if not is_there():
        return []
    with LenslessPeer(ENVIRONMENT, rounds, memory=True) as lensless:
        try:
            return [
                (result.name, result.seconds * 1e3, result.peak_mb or 0.0, result.picture)
                for result in lensless(y, psf)
            ]
        except SettingError as error:
            print(f"LenslessPiCam is left out: {error.message}")
            return []
