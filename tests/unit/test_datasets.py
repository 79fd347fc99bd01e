"""Data sets in local folders: recognition of every layout, orientation, channels, PSFs, truths and refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from device.clock import VirtualClock
from device.errors import FrameError, PsfError, SettingError
from services.research.dataset_pairs import Pair
from services.research.dataset_summary import check, summary
from services.research.datasets import open_dataset
from tests.companions import add_companions
from tests.datasets import COLS, ROWS, WRITERS, Scene, simulate_tiny, stored, write_dlmd, write_pairs


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate_tiny(tmp_path_factory.mktemp("scene"))


FOUND = {  # layout, names, number of truths, number of PSFs
    "dlmd": ("dlmd", ["im2", "im10"], 2, 1),
    "full dlmd": ("dlmd", ["im2", "im3"], 2, 1),
    "lenslesspicam": ("lenslesspicam", ["0", "1"], 1, 1),
    "lenslesspicam-raw": ("lenslesspicam-raw", ["thumbs_up"], 0, 1),
    "diffusercam-3d": ("diffusercam-3d", ["example_raw"], 0, 3),
    "matlab": ("diffusercam-3d", ["example_raw"], 0, 3),
    "diffusercam-tutorial": ("diffusercam-tutorial", ["rawdata_hand_sample"], 0, 1),
    "simulated": ("simulated", ["a", "b"], 2, 1),
    "pairs": ("pairs", ["eye1", "eye2", "eye3"], 2, 1),
}


@pytest.mark.parametrize("layout", WRITERS)
def test_a_layout_is_recognised_and_its_first_pair_is_upright(layout: str, scene: Scene, tmp_path: Path) -> None:
    WRITERS[layout](tmp_path / "set", scene)
    add_companions(tmp_path / "set")
    dataset = open_dataset(tmp_path / "set")
    truths = sum(entry.truth is not None for entry in dataset.entries)
    pair = next(iter(dataset))
    found = dataset.layout.name, [entry.name for entry in dataset.entries], truths, len(pair.psfs)
    assert found == FOUND[layout]
    assert pair.shape == (ROWS, COLS)
    assert pcc(grey(pair), scene.raw) > 0.999
    assert pair.simulated is (layout == "simulated")
    assert max(pcc(psf.pixels, scene.psf) for psf in pair.psfs) > 0.999
    if truths:
        assert pair.truth is not None
        assert pcc(np.atleast_3d(pair.truth).mean(axis=2), scene.truth) > 0.999
    assert f"{len(dataset)}, {truths} with a truth" in summary(dataset)


def grey(pair: Pair) -> np.ndarray:
    return np.atleast_3d(pair.raw.pixels).mean(axis=2)


def pcc(left: np.ndarray, right: np.ndarray) -> float:
    return float(np.corrcoef(left.ravel(), right.ravel())[0, 1])


def test_channels_are_red_green_blue(scene: Scene, tmp_path: Path) -> None:
    write_dlmd(tmp_path, scene)
    pixels = next(iter(open_dataset(tmp_path))).raw.pixels
    assert np.array_equal(pixels, scene.colour)
    assert pixels.flags.c_contiguous


def test_dlmd_is_compared_in_the_crop_of_its_authors(scene: Scene, tmp_path: Path) -> None:
    """Stored rows 0:210 and columns 62:442 of 270 x 480; upright the last 210 rows."""
    truth = np.arange(270 * 480 * 3, dtype=np.float32).reshape(270, 480, 3)
    for folder in ("diffuser", "lensed"):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "im1.npy", truth)
    np.save(tmp_path / "psf.npy", np.eye(270, 480, dtype=np.float32))
    pair = next(iter(open_dataset(tmp_path)))
    assert pair.truth is not None
    known = np.isfinite(pair.truth)
    assert known.sum() == 210 * 380 * 3
    assert np.array_equal(pair.truth[known], stored(truth)[60:270, 62:442].ravel())


def test_a_half_turn_keeps_the_centre_of_the_psf_and_the_truth_is_placed(tmp_path: Path) -> None:
    """DigiCam's frames and PSFs are rotated, its truths are not, and have another size."""
    folder, psf = tmp_path / "DigiCam-Mirflickr-SingleMask-25K", np.zeros((380, 508), np.float32)
    psf[190, 254], psf[190, 260] = 1, 0.5
    raw = np.arange(380 * 508, dtype=np.float32).reshape(380, 508)
    for name, array in (("lensless", raw), ("lensed", np.tile(np.arange(40, dtype=np.float32), (30, 1)))):
        (folder / name).mkdir(parents=True)
        np.save(folder / name / "1.npy", array)
    np.save(tmp_path / "psf.npy", psf)
    with pytest.raises(SettingError, match="no PSF that fits"):
        open_dataset(folder)
    dataset = open_dataset(folder, psf=tmp_path / "psf.npy")
    pair = next(iter(dataset))
    assert np.array_equal(pair.raw.pixels, raw[::-1, ::-1])
    assert np.argmax(pair.psfs[0].pixels) == 190 * 508 + 254
    assert pair.psfs[0].pixels[190, 248] > 0
    assert pair.truth is not None
    inside = pair.truth[80:280, 100:366]
    assert np.isfinite(inside).all()
    assert np.isfinite(pair.truth).sum() == inside.size
    assert inside[0, 0] < 1 < 38 < inside[-1, -1]
    assert "rotated by 180 degrees: turned upright" in summary(dataset)


def test_the_list_of_test_files_can_be_left_out(scene: Scene, tmp_path: Path) -> None:
    WRITERS["full dlmd"](tmp_path, scene)
    assert [entry.name for entry in open_dataset(tmp_path, split="all").entries] == ["im2", "im3", "im1001"]
    assert open_dataset(tmp_path).notes == (
        "2 of 3 raw frames are in the list of test files.",
        "1 names of the list of test files have no raw frame here.",
    )


def test_a_folder_of_no_known_layout_is_refused_with_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    with pytest.raises(SettingError, match=r"diffuser_images/ and ground_truth_lensed/.*psf_sample\.tif") as refusal:
        open_dataset(tmp_path)
    assert "Give the folder that holds these files" in refusal.value.remedy
    (tmp_path / "data" / "train-00000-of-00001.parquet").touch()
    with pytest.raises(SettingError) as refusal:
        open_dataset(tmp_path)
    assert "Export the parquet files as pictures" in refusal.value.remedy
    with pytest.raises(SettingError, match="is not a folder"):
        open_dataset(tmp_path / "none")


def test_several_psfs_that_fit_are_refused(scene: Scene, tmp_path: Path) -> None:
    WRITERS["lenslesspicam-raw"](tmp_path, scene)
    np.save(tmp_path / "psf" / "second.npy", scene.psf)
    with pytest.raises(SettingError, match=r"2 PSFs that fit its raw frames \(second\.npy, tape\.npy\)"):
        open_dataset(tmp_path)
    assert open_dataset(tmp_path, psf=tmp_path / "psf" / "tape.npy").entries[0].psfs[0].name == "tape.npy"


@pytest.mark.parametrize(
    ("file", "error", "message"),
    [
        ("truth", FrameError, "its layout states no place of the truth"),
        ("psf", PsfError, "has 20 x 30 pixels, the raw 60 x 80"),
    ],
)
def test_a_file_of_another_size_is_refused(
    file: str, error: type[Exception], message: str, scene: Scene, tmp_path: Path
) -> None:
    write_pairs(tmp_path, scene)
    dataset, small = open_dataset(tmp_path), tmp_path / "small.npy"
    np.save(small, np.ones((20, 30), np.float32))
    first = dataset.entries[0]
    changed = replace(first, truth=small) if file == "truth" else replace(first, psfs=(small,))
    with pytest.raises(error, match=message):
        dataset.read(changed)


def test_check_names_the_files_that_cannot_be_used(scene: Scene, tmp_path: Path) -> None:
    write_pairs(tmp_path, scene)
    np.save(tmp_path / "raw" / "eye4.npy", scene.colour)
    lines: list[str] = []
    problems = check(open_dataset(tmp_path), VirtualClock(), lines.append)
    assert [problem.pair for problem in problems] == ["eye3", "eye4"]
    assert "eye3.npy is not a whole npy image" in problems[0].reason
    assert "(60, 80, 3)" in problems[1].reason
