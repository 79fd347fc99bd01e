"""`diffuscope frontier` as a process: points and plot of a small scene, and refusals."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from device.recon.methods import METHODS
from services.cli import main
from tests.journey.test_reconstruct_options import caustic, mosaic_dng, scene
from tests.journey.wrong_inputs import call

ROOT = Path(__file__).parents[2]
COMMAND = str(Path(sys.executable).parent / "diffuscope")
DIABETIC = ROOT / "device" / "sim" / "scenes" / "diabetic.toml"
POINT = {
    "method",
    "bin",
    "rounds",
    "seconds_median",
    "seconds_p95",
    "pcc",
    "psnr_db",
    "ssim",
    "highpass_pcc",
    "vessel_contrast",
    "pareto",
}
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def diffuscope(tmp_path_factory: pytest.TempPathFactory) -> Run:
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [COMMAND, *map(str, words)]
        return subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=150, check=False
        )

    return run


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The diabetic scene with pixels of twelve times the width."""
    text = DIABETIC.read_text()
    sensor_line = 'sensor = "quantalux"\n'
    assert sensor_line in text
    text = text.replace(sensor_line, sensor_line + "rows = 90\ncols = 160\npitch_um = 60.48\n")
    path = tmp_path_factory.mktemp("scene") / "tiny.toml"
    path.write_text(text)
    return path


def test_small_scene_gives_points_choice_and_plot(diffuscope: Run, tiny: Path, tmp_path: Path) -> None:
    found, plot = tmp_path / "f.json", tmp_path / "f.svg"
    done = diffuscope("frontier", "--scene", tiny, "--json", found, "--plot", plot, "--repeats", 5, "--budget-s", 5)
    assert done.returncode == 0, done.stderr
    facts = json.loads(found.read_text())
    assert {"machine", "versions", "scene", "region", "points", "budget_s", "choice", "dominated"} <= set(facts)
    assert {"cpu", "cores"} <= set(facts["machine"])
    assert facts["simulated"] is True
    assert {"what", "intensity_fit", "psnr_range"} <= set(facts["region"])
    assert all(set(point) == POINT for point in facts["points"])
    assert {point["method"] for point in facts["points"]} == set(METHODS)
    validated = {point["bin"]: point for point in facts["points"] if point["method"] == "tikhonov"}
    assert {best["bin"] for best in facts["best_mu"]} == set(validated)
    for best in facts["best_mu"]:  # best of eight weights, compared with the estimate from the frame alone
        assert 1e-6 <= best["mu"] <= 3.2e-3
        assert best["pcc"] > validated[best["bin"]]["pcc"] - 0.01
        assert 0 < best["seconds_median"] < 5
    assert done.stdout.count("tikhonov with the best mu") == len(validated)
    assert {p["rounds"] for p in facts["points"] if p["method"] == "variation"} == {0, 1, 2, 4, 8, 12, 20}
    edge = sorted((p["seconds_median"], p["psnr_db"]) for p in facts["points"] if p["pareto"])
    assert edge == sorted(edge, key=lambda place: place[1])
    assert {"method", "bin", "rounds", "seconds_median"} <= set(facts["choice"])
    assert facts["choice"]["method"] == "variation", "five seconds are enough for everything"
    root = ElementTree.parse(plot).getroot()
    assert root.tag.endswith("svg")
    light = facts["light"]
    assert [(row["frames"], row["used"]) for row in light] == [(n, n) for n in (1, 2, 4, 8)]
    assert light[3]["dose_j_per_cm2"] == pytest.approx(8 * light[0]["dose_j_per_cm2"])
    assert light[0]["psnr_db"] == pytest.approx(facts["choice"]["psnr_db"], abs=1e-6), "one frame is the choice"
    assert light[3]["psnr_db"] > light[0]["psnr_db"] + 0.5  # eight times the light
    bounds = [row["bound_psnr_db"] for row in light]
    assert bounds == sorted(bounds)
    assert "8 frames (8 used)" in done.stdout
    assert "8 frames, " in plot.read_text()
    embedded = [image.get("href") or "" for image in root.iter("{http://www.w3.org/2000/svg}image")]
    assert 3 <= len(embedded) <= 5, "pictures of two to four points, and the truth"
    assert all(link.startswith("data:image/png;base64,") for link in embedded)
    assert facts["region"]["field_known"] is True
    assert "open, bin" not in plot.read_text()
    assert "Diabetic scene" in done.stderr
    assert "the instrument chooses variation" in done.stdout
    assert len([line for line in done.stderr.splitlines() if " dB, PCC " in line]) == len(facts["points"])


def test_files_give_the_same_scores_as_a_scene(diffuscope: Run, tiny: Path, tmp_path: Path) -> None:
    """With the head's geometry the scores are equal; the PSF file has no noise, so they may only be better."""
    assert diffuscope("simulate", tiny, "-o", tmp_path).returncode == 0
    files = ("--raw", tmp_path / "raw.tiff", "--psf", tmp_path / "psf.tiff", "--truth", tmp_path / "truth.npy")
    out = ("--json", tmp_path / "f.json", "--plot", tmp_path / "f.svg", "--repeats", 1)
    done = diffuscope("frontier", *files, "--head", tiny, *out, "--method", "tikhonov")  # not the one that it chooses
    assert done.returncode == 0, done.stderr
    facts = json.loads((tmp_path / "f.json").read_text())
    assert facts["region"]["shift_px"] == [0, 0]
    assert "field" in facts["region"]["what"]
    assert facts["choice"]["pcc"] > 0.5


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "--raw, --psf, --truth and --scene are missing"),
        (("--raw", "raw.npy", "--psf", "psf.npy"), "--truth and --scene are missing"),
        (("--raw", "raw.npy", "--psf", "psf.npy", "--truth", "none.npy"), "No such file"),
        (("--raw", "raw.npy", "--psf", "psf.npy", "--truth", "small.npy"), "8 x 8 pixels, the raw 16 x 24"),
        (("--raw", "raw.npy", "--psf", "small.npy", "--truth", "raw.npy"), "small.npy has 8 x 8 pixels"),
        (("--raw", "raw.npy", "--psf", "psf.npy", "--truth", "dull.npy"), "the same everywhere"),
        (("--scene", DIABETIC, "--raw", "raw.npy"), "--raw has no place"),
        (("--scene", DIABETIC, "--budget-s", "0"), "is not a time"),
        (("--scene", "none.toml"), "none.toml"),
        (("--scene", DIABETIC, "--plot", "nowhere/f.svg"), "a folder that does not exist"),
        (("--scene", DIABETIC, "--plot", "f.png"), "Choose a name in .svg"),
    ],
)
def test_impossible_measurement_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[object, ...], says: str
) -> None:
    rng = np.random.default_rng(0)
    np.save(tmp_path / "raw.npy", rng.integers(1, 999, (16, 24)).astype(np.uint16))
    np.save(tmp_path / "psf.npy", np.pad(np.ones((4, 4), np.float32), ((6, 6), (10, 10))))
    np.save(tmp_path / "small.npy", np.ones((8, 8), np.float32))
    np.save(tmp_path / "dull.npy", np.ones((16, 24), np.float32))
    files = ("raw.npy", "psf.npy", "small.npy", "dull.npy", "none.npy", "none.toml", "nowhere/f.svg")
    asked = [tmp_path / str(word) if word in files else word for word in words]
    if "--plot" not in words:
        asked += ["--plot", tmp_path / "f.svg"]
    with pytest.raises(SystemExit) as stop:
        main(["frontier", *map(str, asked), "--json", str(tmp_path / "f.json")])
    assert stop.value.code == 2
    printed = capsys.readouterr().err
    assert says in printed
    assert not (tmp_path / "f.json").exists()


def test_a_colour_mosaic_is_refused_as_one(tmp_path: Path) -> None:
    raw = mosaic_dng(tmp_path / "mosaic.dng")
    np.save(tmp_path / "psf.npy", caustic())
    np.save(tmp_path / "truth.npy", scene())
    words = ["--raw", str(raw), "--psf", str(tmp_path / "psf.npy"), "--truth", str(tmp_path / "truth.npy")]
    outputs = ["--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.svg"), "--no-peers"]
    answer = call(["frontier", *words, *outputs])
    assert answer.code == 2
    assert "mosaic.dng is a colour mosaic (bggr)" in answer.err
