"""Tests of the raw recorder: every frame is stored beside the calibration, and a full disk ends only the recording."""

import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from device.calibration.archive import Archive
from device.calibration.procedure.calibration_sequence import CalibrationJob, CalibrationSequence, Operator
from device.calibration.procedure.raw_recorder import RawRecorder
from device.head import target_placer
from device.sim.camera import SimCamera
from device.sim.world import World
from device.values import Frame
from tests.unit.test_calibration_measurements import small_world


def calibrated(world: World, root: Path, messages: list[str]) -> str:
    job = CalibrationJob(world.spec, "D-1", "a technician", "0.1.0", keep_raw=True)
    operator = Operator(target_placer(world), messages.append)
    return CalibrationSequence(job, SimCamera(world), operator, world.clock, root / ".steps").run(Archive(root))


@contextmanager
def file_size_limit(most_bytes: int) -> Iterator[None]:
    """Limit the file size, as a full disk would."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


def test_every_frame_is_stored_with_its_digest(tmp_path: Path) -> None:
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


def test_a_write_error_is_reported_once_and_the_calibration_continues(tmp_path: Path) -> None:
    messages: list[str] = []
    (tmp_path / ".steps").mkdir()
    (tmp_path / ".steps" / "raw").write_text("a file where the folder should be")
    id = calibrated(small_world(coarser=8), tmp_path, messages)
    assert Archive(tmp_path).active_id() == id
    assert sum("cannot be written" in line for line in messages) == 1


def test_a_partial_file_is_deleted_after_a_write_error(tmp_path: Path) -> None:
    messages: list[str] = []
    raws = RawRecorder(tmp_path / "raw", messages.append)
    raws.begin_step("darks")
    small, large = (Frame(np.ones((8, n), np.uint16), 0.1, 1, None, True) for n in (8, 800))
    raws.record(small)
    with file_size_limit(1000):
        raws.record(large)
    raws.record(small)
    assert raws.frame_count == 1
    assert [path.name for path in (tmp_path / "raw" / "darks").glob("*.npy")] == ["00001_0.1s.npy"]
    assert len(messages) == 1
    assert "frame 2 of darks" in messages[0]


def test_disk_space_for_the_calibration_is_reserved(tmp_path: Path) -> None:
    messages: list[str] = []
    raws = RawRecorder(tmp_path / "raw", messages.append, reserve_bytes=10**18)
    raws.begin_step("darks")
    raws.record(Frame(np.ones((8, 8), np.uint16), 0.1, 1, None, True))
    assert raws.frame_count == 0
    assert "less than 1000000000000 MB are left" in messages[0]
