"""Frames of a press on the disk: bit-exact, incomplete ones left out, a full disk does not stop the press."""

import logging
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from device.values import Calibration, Frame, Illumination, Psf, Sensor
from services.imaging.raw_metadata import RawMetadata
from services.instrument.frame_sink import FrameSink
from services.instrument.resumption import SHORTER, resumed_frames
from services.records import blobs
from services.records.capture_journal import InterruptedCapture, ResumableCapture
from services.records.frame_writer import FrameWriter, StoredFrame, stored_frames
from services.records.patient_keys import PatientKeys

NOON = datetime(2026, 3, 1, 12, 0, 0, 123456, tzinfo=UTC)
SHARED = RawMetadata("20260301T120000-OD-aa", "OD", NOON, calibration_id="00ff", head="head")
GREEN, RED = Illumination("green"), Illumination("red", 0.5)
LIGHTS = (GREEN, GREEN, RED, None)
NAMES = ["raw.tiff", "raw-1.tiff", "raw-red.tiff", "dark.tiff"]


def frames(shape: tuple[int, int] = (40, 60)) -> list[Frame]:
    random = np.random.default_rng(5)
    return [
        Frame(random.integers(0, 65536, shape, np.uint16), 0.125, 7 + k, light, True) for k, light in enumerate(LIGHTS)
    ]


@pytest.fixture
def keys(tmp_path_factory: pytest.TempPathFactory) -> PatientKeys:
    return PatientKeys(tmp_path_factory.mktemp("keys"), None)


def write(folder: Path, taken: list[Frame], keys: PatientKeys) -> FrameWriter:
    writer = FrameWriter(folder, partial(blobs.encrypted, keys, ""))
    sink = FrameSink(writer, SHARED, "green")
    for k, frame in enumerate(taken):
        sink(frame, 1e-5 * (k + 1), 0.1 * (k + 1))
    return writer


def names(stored: tuple[StoredFrame, ...]) -> list[str]:
    return [frame.file.path.name for frame in stored]


def test_frames_are_read_as_they_were_taken_with_dose_light_and_number(tmp_path: Path, keys: PatientKeys) -> None:
    taken = frames()
    writer = write(tmp_path / "press", taken, keys)
    files = writer.finish()
    stored = stored_frames(tmp_path / "press", keys)
    assert names(stored) == NAMES
    assert [stored_frame.is_lit for stored_frame in stored] == [True, True, False, False]
    assert {stored_frame.number: stored_frame.file for stored_frame in stored} == files
    assert [stored_frame.dose_j_per_cm2 for stored_frame in stored] == pytest.approx([1e-5, 2e-5, 3e-5, 4e-5])
    assert stored[-1].exposed_s == pytest.approx(0.4)
    for stored_frame, before in zip(stored, taken, strict=True):
        frame, metadata = stored_frame.load()
        assert np.array_equal(frame.counts, before.counts)
        assert (frame.exposure_s, frame.number, frame.illumination, frame.simulated) == (
            before.exposure_s,
            before.number,
            before.illumination,
            True,
        )
        assert (metadata.id, metadata.eye, metadata.taken_at) == (SHARED.id, "OD", NOON)
        assert (metadata.calibration_id, metadata.head) == ("00ff", "head")
    writer.close()


@pytest.mark.parametrize("file", ["raw-1.tiff", "raw-1.tiff.json"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99, None])
def test_a_frame_that_a_power_cut_has_truncated_is_left_out(
    tmp_path: Path, keys: PatientKeys, file: str, share: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, frames(), keys).finish()
    path = tmp_path / file
    if share is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert names(stored_frames(tmp_path, keys)) == ["raw.tiff", "raw-red.tiff", "dark.tiff"]
    assert bool(caplog.records) == (path.name == "raw-1.tiff" or share is not None), "a missing note is no error"


def test_one_changed_bit_is_not_taken_for_a_frame(tmp_path: Path, keys: PatientKeys) -> None:
    write(tmp_path, frames(), keys).finish()
    for name in ("raw.tiff", "dark.tiff.json"):
        content = bytearray((tmp_path / name).read_bytes())
        content[len(content) // 2] ^= 1
        (tmp_path / name).write_bytes(content)
    assert names(stored_frames(tmp_path, keys)) == ["raw-1.tiff", "raw-red.tiff"]


@contextmanager
def files_of_at_most(length_bytes: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (length_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_the_frames_before_it_and_one_line_in_the_log(
    tmp_path: Path, keys: PatientKeys, caplog: pytest.LogCaptureFixture
) -> None:
    taken = frames()
    large = frames((200, 300))
    with files_of_at_most(20_000), caplog.at_level(logging.WARNING):
        writer = write(tmp_path, [taken[0], large[1], taken[2], taken[3]], keys)
        files = writer.finish()
        writer.close()
    assert list(files) == [taken[0].number]
    assert [record.message for record in caplog.records if "stay in memory" in record.message] != []
    assert len(caplog.records) == 1
    assert names(stored_frames(tmp_path, keys)) == ["raw.tiff"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["raw.tiff", "raw.tiff.json"], "no part of a frame stays"


def test_a_folder_that_cannot_be_made_is_logged_and_the_frames_are_in_no_file(
    tmp_path: Path, keys: PatientKeys, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert write(tmp_path / "file" / "press", frames(), keys).finish() == {}
    assert len(caplog.records) == 1


def test_close_writes_nothing_more_than_the_frame_that_is_being_written(tmp_path: Path, keys: PatientKeys) -> None:
    writer = write(tmp_path, frames((1500, 2000)), keys)
    writer.close()
    count = len(list(tmp_path.iterdir()))
    Event().wait(0.2)
    assert len(list(tmp_path.iterdir())) == count <= 2


def test_a_frame_that_is_lost_between_others_is_reported(tmp_path: Path, keys: PatientKeys) -> None:
    """The dark frame is on the disk, but not the second lit one: the burst is shorter all the same."""
    write(tmp_path, frames(), keys).finish()
    (tmp_path / "raw-1.tiff").write_bytes(b"")
    press = InterruptedCapture(SHARED.id, "OD", None, None, 1)
    stored = ResumableCapture(press, None, 2, ("red",), stored_frames(tmp_path, keys))
    calibration = Calibration((Psf(np.ones((40, 60), np.float32)),), Sensor())
    assert SHORTER.format(taken=1, planned=2) in resumed_frames(stored, calibration, 0.0).notes
