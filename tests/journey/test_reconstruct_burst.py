"""`diffuscope reconstruct RAW RAW ...`: one picture of a burst, with what became of each raw."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from tests.journey.wrong_inputs import Answer, call
from tests.moving_retina import DRIFT_PX, PSF, RETINA, SHAPE, field, frame, seen


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a burst of three frames, a closed lid, a smaller frame, a frame of NaN, and the PSF."""
    folder = tmp_path_factory.mktemp("burst")
    for k, moved in enumerate(DRIFT_PX[:3]):
        np.save(folder / f"{k}.npy", frame(seen(RETINA, moved), 5000, k))
    np.save(folder / "lid.npy", frame(0.4 * field(), 5000, 8))
    np.save(folder / "small.npy", frame(seen(RETINA, (0, 0)), 5000, 1)[8:-8])
    np.save(folder / "nan.npy", np.full(SHAPE, np.nan, np.float32))
    centred = np.zeros(SHAPE, np.float32)
    centred[140:221, 200:281] = PSF.pixels
    np.save(folder / "psf.npy", (centred / centred.max() * 60000).astype(np.uint16))
    return folder


def reconstruct(folder: Path, *names: str) -> list[str]:
    out = ["-o", str(folder / "out.npy"), "--report", str(folder / "report.json")]
    return ["reconstruct", *(str(folder / name) for name in names), "--psf", str(folder / "psf.npy"), *out]


def refusal(answer: Answer) -> str:
    assert answer.code == 2, answer.err
    return answer.err


def test_a_burst_gives_one_picture_and_its_report_names_every_frame(folder: Path) -> None:
    done = call(reconstruct(folder, "0.npy", "1.npy", "lid.npy", "2.npy"))
    assert done.code == 0, done.err
    assert "lid.npy was left out" in done.err
    report = json.loads((folder / "report.json").read_text())
    assert [use["used"] for use in report["frames"]] == [True, True, False, True]
    assert report["frames"][0]["shift_px"] == [0, 0]
    for place, moved_px in ((1, DRIFT_PX[1]), (3, DRIFT_PX[2])):
        assert report["frames"][place]["shift_px"] == pytest.approx(moved_px, abs=0.3)  # a sixth of a sample
    assert np.load(folder / "out.npy").shape == SHAPE
    alone = call(reconstruct(folder, "0.npy"))
    assert alone.code == 0
    (only,) = json.loads((folder / "report.json").read_text())["frames"]
    assert only == {"index": 0, "used": True, "shift_px": [0.0, 0.0], "weight": 1.0, "reason": None}


def test_a_frame_without_values_is_left_out_and_a_smaller_one_is_refused(folder: Path) -> None:
    done = call(reconstruct(folder, "0.npy", "nan.npy", "1.npy"))
    assert done.code == 0, done.err
    text = (folder / "report.json").read_text()
    report = json.loads(text)
    assert [use["used"] for use in report["frames"]] == [True, False, True]
    assert "not numbers" in report["frames"][1]["reason"]
    assert any(warning.startswith("nan.npy was left out") for warning in report["warnings"])
    assert str(folder) not in text, "a report is read by others, too: it names files, not folders"
    assert "344 x 480 pixels" in refusal(call(reconstruct(folder, "0.npy", "small.npy")))
    assert "no frame of the burst can be used" in refusal(call(reconstruct(folder, "nan.npy", "nan.npy")))


def test_no_raw_of_a_burst_is_overwritten(folder: Path) -> None:
    before = (folder / "1.npy").read_bytes()
    words = ["reconstruct", str(folder / "0.npy"), str(folder / "1.npy"), "--psf", str(folder / "psf.npy")]
    for out in (["-o", str(folder / "1.npy")], ["-o", str(folder / "x.npy"), "--report", str(folder / "1.npy")]):
        assert "would be overwritten" in refusal(call([*words, *out]))
    assert (folder / "1.npy").read_bytes() == before
    assert "Leave --even and --sweep out." in refusal(call([*words, "-o", str(folder / "x.npy"), "--even"]))
    sweep = call([*words, "-o", str(folder / "x.npy"), "--sweep", str(folder / "s.svg")])
    assert "Leave --even and --sweep out." in refusal(sweep)


def test_a_burst_without_its_first_frame_is_refused(folder: Path) -> None:
    """The picture would be on another grid than that of the first raw: a lid, or no values."""
    (folder / "out.npy").unlink(missing_ok=True)
    for first in ("lid.npy", "nan.npy"):
        says = refusal(call(reconstruct(folder, first, "0.npy", "1.npy", "2.npy")))
        assert f"the first frame of the burst, {folder / first}, was left out" in says
    assert not (folder / "out.npy").exists()


def test_psfs_among_the_frames_are_refused(folder: Path) -> None:
    """As a shell writes `raw.npy --psf psf*.npy`, and as a burst of PSFs without a raw."""
    others = [psf_of_another_depth(folder, zoom) for zoom in (0.95, 1.05, 1.1)]
    words = ["reconstruct", str(folder / "0.npy"), "--psf", str(folder / "psf.npy"), *others, "-o", "out.npy"]
    assert "--psf A --psf B" in refusal(call(words))
    for frames in (["0.npy", *others], others):
        says = refusal(call(reconstruct(folder, *frames)))
        assert "looks like a PSF" in says
        assert "--psf A --psf B" in says


def psf_of_another_depth(folder: Path, zoom: float) -> str:
    place = folder / f"depth{zoom}.npy"
    scaled = ndimage.zoom(PSF.pixels.astype(np.float64), zoom, order=1)
    rows, cols = scaled.shape
    centred = np.zeros(SHAPE)
    top, left = (SHAPE[0] - rows) // 2, (SHAPE[1] - cols) // 2
    centred[top : top + rows, left : left + cols] = scaled
    counts = centred / centred.max() * 4000 + np.random.default_rng(int(zoom * 100)).normal(60, 2, SHAPE)
    np.save(place, counts.astype(np.uint16))
    return str(place)


def test_the_same_exposure_twice_is_no_burst(folder: Path) -> None:
    np.save(folder / "copy.npy", np.load(folder / "1.npy"))
    assert "holds the same pixels as" in refusal(call(reconstruct(folder, "0.npy", "1.npy", "copy.npy")))
    channels = [word for name in ("0.npy", "0.npy") for word in ("--channel", "green", name, "psf.npy")]
    words = ["reconstruct", *(str(folder / word) if word.endswith(".npy") else word for word in channels)]
    words += ["--channel", "red", str(folder / "1.npy"), str(folder / "psf.npy"), "-o", str(folder / "x.npy")]
    assert "holds the same pixels as" in refusal(call(words))


def test_raws_after_an_option_are_frames_where_none_stands_before(folder: Path) -> None:
    words = ["reconstruct", "--psf", str(folder / "psf.npy"), str(folder / "0.npy"), str(folder / "1.npy")]
    done = call([*words, "-o", str(folder / "after.npy")])
    assert done.code == 0, done.err


def test_a_folder_of_psfs_is_a_stack(folder: Path) -> None:
    stack = folder / "psfs"
    stack.mkdir()
    for name, source in (("d2.npy", psf_of_another_depth(folder, 1.1)), ("d10.npy", folder / "psf.npy")):
        (stack / name).write_bytes(Path(source).read_bytes())
    (stack / "._d2.npy").write_bytes(b"a companion of macOS")
    words = ["reconstruct", str(folder / "0.npy"), "-o", str(folder / "x.npy"), "--report", str(folder / "r.json")]
    done = call([*words, "--psf", str(stack)])
    assert done.code == 0, done.err
    assert json.loads((folder / "r.json").read_text())["psf_index"] == 1  # d10 after d2
    (folder / "empty").mkdir()
    assert "holds no PSF" in refusal(call([*words, "--psf", str(folder / "empty")]))
