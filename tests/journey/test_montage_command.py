"""`diffuscope montage`: the picture, its report, and wrong inputs."""

import json
from pathlib import Path

import numpy as np
import pytest

from services.imaging.picture_files import to_png
from services.research.montage_files import read_picture
from tests.journey.wrong_inputs import call
from tests.moving_retina import WIDE_RETINA, gaze


def test_two_pictures_are_joined_and_their_places_reported(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", gaze(WIDE_RETINA, (0, 0)))
    np.save(tmp_path / "b.npy", gaze(WIDE_RETINA, (60, -20), 0, 1))
    words = ["montage", str(tmp_path / "a.npy"), str(tmp_path / "b.npy")]
    done = call([*words, "-o", str(tmp_path / "out.tiff"), "--report", str(tmp_path / "r.json")])
    assert done.code == 0, done.err
    assert "2 of 2 pictures on the plane" in done.out
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["projection"], report["px_per_deg"]) == ("plane", None), "the scale of the pictures is unknown"
    first, second = report["placed"]
    assert set(first) == {"index", "used", "shift_px", "rotation_deg", "peak", "overlap", "reason"}
    assert (first["shift_px"], first["rotation_deg"], first["used"]) == ([0, 0], 0, True)
    assert np.allclose(second["shift_px"], (60, -20), atol=0.6)  # as in the unit test
    assert call([*words, "-o", str(tmp_path / "out.png")]).code == 0
    head = str(Path("hardware/heads/paper.toml"))
    done = call([*words, "-o", str(tmp_path / "out.npy"), "--head", head, "--report", str(tmp_path / "r.json")])
    assert "2 of 2 pictures on the sphere" in done.out, done.err
    assert json.loads((tmp_path / "r.json").read_text())["px_per_deg"] == pytest.approx(15.583, abs=1e-3)  # the paper's


def test_a_png_is_read_as_the_light_that_it_shows(tmp_path: Path) -> None:
    first = gaze(WIDE_RETINA, (0, 0))
    (tmp_path / "a.png").write_bytes(to_png(first, simulated=False))
    light = read_picture(tmp_path / "a.png")
    inside = (first > 0.5) & (light < 1)  # the window of a PNG clips the brightest pixels
    assert np.corrcoef(light[inside], first[inside])[0, 1] > 0.9995  # 8 bits
    line = np.polyfit(first[inside], light[inside], 1)
    assert np.abs(np.polyval(line, first[inside]) - light[inside]).max() < 0.02  # gamma alone would bend it by 0.1


def test_wrong_inputs_are_refused_with_the_remedy(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", gaze(WIDE_RETINA, (0, 0)))
    np.save(tmp_path / "black.npy", np.zeros((256, 256), np.float32))
    a, out = str(tmp_path / "a.npy"), str(tmp_path / "out.npy")
    for words, message in (
        ([a, str(tmp_path / "black.npy"), "-o", out], "black.npy is black"),
        ([a, str(tmp_path / "none.npy"), "-o", out], "none.npy"),
        ([a, "-o", a], "would be overwritten"),
        ([a, "-o", str(tmp_path / "out.jpg")], "Choose one of these."),
        ([a, "-o", out, "--head", "hardware/heads/bench.toml"], "has no table [optics]"),
    ):
        done = call(["montage", *words])
        assert (done.code, message in done.err) == (2, True), done.err
