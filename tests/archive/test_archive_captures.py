"""Whole captures of a simulated instrument: bursts and colours reconstructed again, and adopted by the store."""

import shutil
import signal
import subprocess
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

from device.calibration.archive import Archive as Calibrations
from device.calibration.archive import Provenance
from device.clock import VirtualClock
from device.config.head_file import load_head
from device.sim.render import crop_or_pad
from device.values import Calibration, Colour, Eye, Psf
from services.imaging.picture_files import read_png
from services.records.capture import Capture
from services.records.capture_store import CaptureStore
from services.records.capture_target import CaptureTarget
from services.records.store_check import check_store
from tests.archive.conftest import COMMAND, Archive, result_digests
from tests.archive.test_archive_runs import wait_for_results
from tests.journey.conftest import SMALL_HEAD, coarsened, rig_builder
from tests.stored_captures import kept_content

TINTS: tuple[Colour, ...] = ("green", "red")
READY_S, PRESS_S = 300.0, 120.0


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Capture]]:
    """The closed store of a simulated instrument: a burst with a frame in red, another one, and a single frame."""
    root = tmp_path_factory.mktemp("instrument")
    (root / "head.toml").write_text(SMALL_HEAD)
    world, calibration = coarsened(load_head(root / "head.toml"))
    psfs = tuple(Psf(crop_or_pad(world.psf(colour), world.shape), colour, colour) for colour in TINTS)
    with ExitStack() as undo:
        rig = rig_builder((world, calibration), root / "plans")(root, undo, tinted=TINTS, wait=False)
        assert rig.exam.ready.wait(READY_S)
        burst, single = CaptureTarget(), CaptureTarget(frames=1, colours=())
        targets: list[tuple[Eye, CaptureTarget]] = [("OD", burst), ("OS", burst), ("OD", single)]
        captures = [rig.exam.press(eye, None, target).result(PRESS_S) for eye, target in targets]
    keep_calibration(root / "store", replace(calibration, psfs=psfs), captures[0])
    return root / "store", captures


def keep_calibration(store: Path, calibration: Calibration, capture: Capture) -> None:
    provenance = Provenance("D1", VirtualClock().wall(), "test", "0")
    id = Calibrations(store / "calibrations" / "small").add_and_activate(calibration, provenance)
    assert id == capture.calibration_id


@pytest.fixture(scope="module")
def ran(
    taken: tuple[Path, list[Capture]], archive: Archive, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A plan of that store and of a folder with frames of one of its captures, and the folder of the run."""
    root = tmp_path_factory.mktemp("ran")
    store, (first, *_) = taken
    place = store / "captures" / first.id
    (root / "folder").mkdir()
    for old, new in (("raw", "eye"), ("raw-1", "eye-1"), ("raw-red", "eye-red")):
        (root / "folder" / f"{new}.tiff").write_bytes(kept_content(place / f"{old}.tiff"))
    (kept,) = (store / "calibrations" / "small").glob("*/")
    stored = Calibrations(kept.parent).load(kept.name).calibration
    for psf in stored.psfs:
        name = "psf.tiff" if psf.colour == "green" else f"psf-{psf.colour}.tiff"
        tifffile.imwrite(root / "folder" / name, psf.pixels)
    done = archive("plan", store, root / "folder", "-o", root / "plan.toml")
    assert "4 captures with 2 calibrations" in done.stdout, done.stderr
    done = archive("run", root / "plan.toml", "-o", root / "out", "--workers", 1)
    assert done.returncode == 0, done.stderr
    return root / "plan.toml", root / "out"


def test_whole_captures_are_computed_as_the_instrument_does(
    taken: tuple[Path, list[Capture]], ran: tuple[Path, Path]
) -> None:
    rows = pd.read_parquet(ran[1] / "captures.parquet").set_index("id")
    store, (burst, other, single) = taken
    for capture in (burst, other):
        row = rows.loc[capture.id]
        used = [frame.used for frame in capture.report.frames]  # a burst may leave out a frame of it
        assert (row["frames"], row["frames_used"]) == (len(used), sum(used))
        assert list(row["channels"]) == ["green", "red"]
        assert list(row["predicted_channels"]) == ["blue"]
        picture = tifffile.imread(ran[1] / row["picture"])
        assert picture.shape == (135, 240)
        assert likeness(picture, store / "captures" / capture.id / "picture.png") > 0.99
        colour = tifffile.imread(ran[1] / row["colour_picture"])
        assert likeness(colour, store / "captures" / capture.id / "colour.png") > 0.99
    assert (rows.loc[single.id, "frames"], len(rows.loc[single.id, "channels"])) == (1, 0)
    assert pd.isna(rows.loc[single.id, "colour_picture"])
    assert (rows.loc["eye", "frames"], list(rows.loc["eye", "channels"])) == (2, ["green", "red"])


def likeness(picture: np.ndarray, stored: Path) -> float:
    """Return the correlation of the middle of a linear picture with that of a stored one, which is cropped."""
    parts = []
    for image in (picture, read_png(kept_content(stored))):
        rows, cols = image.shape[0] // 2, image.shape[1] // 2
        parts.append(image[rows - 20 : rows + 20, cols - 20 : cols + 20].astype(float).ravel())
    return float(np.corrcoef(*parts)[0, 1])


def test_a_killed_run_of_whole_captures_leaves_the_same_bytes(
    ran: tuple[Path, Path], environment: dict[str, str], archive: Archive, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    command = [COMMAND, "archive", "run", str(ran[0]), "-o", str(out), "--workers", "1"]
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as run:
        wait_for_results(out, 1)
        run.send_signal(signal.SIGKILL)
    done = archive("run", ran[0], "-o", out, "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert result_digests(out) == result_digests(ran[1])
    assert any(name.endswith("colour.tiff") for name in result_digests(out))


def test_a_store_adopts_results_once_beside_the_pictures_as_taken(
    taken: tuple[Path, list[Capture]], ran: tuple[Path, Path], archive: Archive, tmp_path: Path
) -> None:
    store = Path(shutil.copytree(taken[0], tmp_path / "store"))
    done = archive("adopt", ran[1], "--data", store)
    assert "3 adopted, 0 adopted before, 1 refused, 0 without a result" in done.stdout, done.stderr
    assert done.returncode == 1
    assert "refused: eye: this store has no capture named 'eye'" in done.stderr
    assert "3 adopted before" in archive("adopt", ran[1], "--data", store).stdout
    with CaptureStore(store, reserve_bytes=0) as kept:
        for before in taken[1]:
            after = kept.get(before.id)
            (version,) = after.report.versions
            assert {name: after.files[name] for name in before.files} == before.files
            new, old = read_png(kept.read(before.id, version.picture)), read_png(kept.read(before.id, "picture.png"))
            assert new.shape == old.shape
            assert np.corrcoef(new.ravel(), old.ravel())[0, 1] > 0.99
            assert (version.colour in after.files) == ("colour.png" in before.files)
            assert version.method == "variation"
        busy = archive("adopt", ran[1], "--data", store)
    assert (busy.returncode, "the instrument is running" in busy.stderr) == (2, True)
    assert next(check for check in check_store(store, lambda _: None) if check.name == "files of captures").is_whole


def test_results_of_other_frames_and_other_folders_are_refused(
    taken: tuple[Path, list[Capture]], ran: tuple[Path, Path], archive: Archive, tmp_path: Path
) -> None:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as other:
        for capture in taken[1]:
            other.save(capture, {"raw.tiff": b"another frame", "picture.png": b"", "report.json": b"{}"})
    done = archive("adopt", ran[1], "--data", tmp_path / "store")
    assert "0 adopted, 0 adopted before, 4 refused" in done.stdout, done.stderr
    assert "holds other frames than the new picture was made from" in done.stderr
    assert "Plan and run the archive again" in done.stderr
    for folder, data, words in (
        (tmp_path, tmp_path / "store", "holds no run"),
        (ran[1], tmp_path / "none", "holds no captures"),
    ):
        done = archive("adopt", folder, "--data", data)
        assert done.returncode == 2
        assert words in done.stderr
