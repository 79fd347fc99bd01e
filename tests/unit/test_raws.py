"""Raw frames are kept as they come, beside the calibration; a full disk ends that and nothing else."""

import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from device.calibration.archive import Archive
from device.calibration.procedure import Job, Operator, Procedure
from device.calibration.raws import Raws
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Frame
from services.instrument.calibrating import staging
from tests.unit.test_measure import small_world


def calibrated(world: World, root: Path, said: list[str]) -> str:
    job = Job(world.spec, "D-1", "a technician", "0.1.0", keep_raw=True)
    operator = Operator(staging(world), said.append)
    return Procedure(job, SimCamera(world), operator, world.clock, root / ".steps").run(Archive(root))


@contextmanager
def room(most_bytes: int) -> Iterator[None]:
    """No file may become longer: what a full disk does to one that is being written."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


def test_every_frame_is_kept_and_its_digest_is_right(tmp_path: Path) -> None:
    world = small_world(coarser=8)
    id = calibrated(world, tmp_path, [])
    folder = tmp_path / f"{id}.raw"
    assert len(list(folder.glob("*/*.npy"))) == world.frames
    for step in ("darks", "flats", "point"):
        done = subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder / step, check=False)
        assert done.returncode == 0
    counts = np.load(next((folder / "darks").glob("*.npy")))
    assert (counts.dtype, counts.shape) == (np.uint16, world.shape)
    assert Archive(tmp_path).ids() == (id,)
    assert not (tmp_path / ".steps").exists()


def test_a_full_disk_is_said_once_and_the_calibration_goes_on(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / ".steps").mkdir()
    (tmp_path / ".steps" / "raw").write_text("a file where the folder should be")
    id = calibrated(small_world(coarser=8), tmp_path, said)
    assert Archive(tmp_path).current() == id
    assert sum("cannot be written" in line for line in said) == 1


def test_what_was_cut_off_by_a_full_disk_is_not_left_behind(tmp_path: Path) -> None:
    said: list[str] = []
    raws = Raws(tmp_path / "raw", said.append)
    raws.begin("darks")
    small, large = (Frame(np.ones((8, n), np.uint16), 0.1, 1, None, True) for n in (8, 800))
    raws.keep(small)
    with room(1000):
        raws.keep(large)
    raws.keep(small)
    assert raws.kept == 1
    assert [path.name for path in (tmp_path / "raw" / "darks").glob("*.npy")] == ["00001_0.1s.npy"]
    assert len(said) == 1
    assert "frame 2 of darks" in said[0]


def test_what_the_calibration_itself_needs_is_left_on_the_disk(tmp_path: Path) -> None:
    said: list[str] = []
    raws = Raws(tmp_path / "raw", said.append, reserve_bytes=10**18)
    raws.begin("darks")
    raws.keep(Frame(np.ones((8, 8), np.uint16), 0.1, 1, None, True))
    assert raws.kept == 0
    assert "less than 1000000000000 MB are left" in said[0]
