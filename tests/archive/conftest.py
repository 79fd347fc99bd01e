"""Fixtures: a folder of small frames as an archive, and the command `diffuscope archive` in processes of its own."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests.datasets import Scene, simulate_tiny

COMMAND = str(Path(sys.executable).parent / "diffuscope")
FRAMES = 24
# The environment of `make test-archive` has Dask; elsewhere these tests cannot be imported.
collect_ignore_glob = [] if find_spec("distributed") else ["test_*.py"]
Archive = Callable[..., "subprocess.CompletedProcess[str]"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test of this folder, so that `make test` leaves it out."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.archive)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate_tiny(tmp_path_factory.mktemp("scene"))


def write_recording(folder: Path, scene: Scene, frames: int = FRAMES) -> Path:
    """Write frames of different noise with their PSF, dark frame and truth in the layout of own pairs."""
    rng = np.random.default_rng(0)
    for name in ("raw", "truth"):
        (folder / name).mkdir(parents=True)
    tifffile.imwrite(folder / "psf.tiff", scene.psf)
    for k in range(frames):
        noisy = rng.poisson(np.maximum(scene.raw.astype(float) * (0.1 if k % 8 == 7 else 1), 0)).astype(np.uint16)
        tifffile.imwrite(folder / "raw" / f"eye{k:03d}.tiff", noisy)
        np.save(folder / "truth" / f"eye{k:03d}.npy", scene.truth)
    return folder


@pytest.fixture
def recording(scene: Scene, tmp_path: Path) -> Path:
    return write_recording(tmp_path / "recording", scene)


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    home = tmp_path_factory.mktemp("home")
    return os.environ | {"XDG_CACHE_HOME": str(home / "cache"), "DASK_TEMPORARY_DIRECTORY": str(home / "dask")}


@pytest.fixture(scope="session")
def archive(environment: dict[str, str]) -> Archive:
    """Run `diffuscope archive` with these words to its end."""

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [COMMAND, "archive", *map(str, words)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)

    return run


@pytest.fixture
def plan(recording: Path, archive: Archive, tmp_path: Path) -> Path:
    path = tmp_path / "plan.toml"
    done = archive("plan", recording, "-o", path, "--rounds", 3)
    assert done.returncode == 0, done.stderr
    return path


def result_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every picture and report below a folder of results, by path; durations are not in them."""
    names = sorted(path for path in folder.glob("results/*/*/*") if path.name != "run.json")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in names}
