"""`diffuscope data`, `bench` and `frontier --data` on tiny data sets, with a stand-in for LenslessPiCam."""

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from device.errors import SettingError
from device.recon.methods import METHODS
from services.cli import main
from services.research.peers import LenslessPeer
from tests.datasets import Scene, simulate_tiny, write_pairs, write_tutorial

# Its "picture" is the frame itself; a frame without contrast ends the program.
STAND_IN = """
class ADMM:
    def __init__(self, psf):
        assert psf.ndim == 4 and abs((psf**2).sum() - psf.shape[3]) < 1e-3
    def set_data(self, data):
        if data.min() == data.max():
            raise SystemExit("no contrast")
        self.data = data
    def apply(self, n_iter, disp_iter, plot):
        return self.data[0]
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate_tiny(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def peers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with a stand-in for LenslessPiCam: its `python` is this one, with another module path."""
    folder = tmp_path_factory.mktemp("peers")
    package = folder / "site" / "lensless" / "recon"
    package.mkdir(parents=True)
    (package / "admm.py").write_text(STAND_IN)
    (folder / "site" / "lensless-1.0.8.dist-info").mkdir()
    (folder / "site" / "lensless-1.0.8.dist-info" / "METADATA").write_text("Name: lensless\nVersion: 1.0.8\n")
    (folder / "bin").mkdir()
    start = f"import runpy, sys; sys.path.insert(0, {str(folder / 'site')!r}); sys.argv = sys.argv[1:]; "
    start += "runpy.run_path(sys.argv[0], run_name='__main__')"
    python = folder / "bin" / "python"
    python.write_text(f'#!/bin/sh\nshift\nexec {sys.executable} -c "{start}" "$@"\n')
    python.chmod(0o755)
    return folder


def run(*words: object) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_data_shows_a_folder_and_checks_its_files(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tutorial(tmp_path / "tutorial", scene)
    assert run("data", tmp_path / "tutorial", "--check") == 0
    printed = capsys.readouterr().out
    assert "DiffuserCam tutorial" in printed
    assert "16-bit words, stored shifted left by 4 bits" in printed
    assert "1 of 1 pairs can be read" in printed
    write_pairs(tmp_path / "own", scene)
    assert run("data", tmp_path / "own", "--check") == 1
    assert "FAIL  eye3:" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    assert run("data", tmp_path / "empty") == 2
    assert "none of the known layouts" in capsys.readouterr().err


def test_bench_gives_one_table_with_the_peer_and_names_the_pair_that_fails(
    scene: Scene, peers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pairs(tmp_path, scene)
    found = tmp_path / "bench.json"
    chosen = ("--method", "gradient", "--method", "tikhonov", "--repeats", 1)
    assert run("bench", tmp_path, *chosen, "--json", found, "--peers", peers) == 1
    printed = capsys.readouterr()
    assert "left out: eye3: " in printed.out
    assert "3 of 3: eye3" in printed.err
    facts = json.loads(found.read_text())
    rows = {row["method"]: row for row in facts["rows"]}
    assert list(rows) == ["gradient", "tikhonov", "LenslessPiCam 1.0.8 ADMM, 100 rounds"]
    for name, row in rows.items():
        assert name in printed.out
        assert row["pairs"] == 2
        assert row["seconds_median"] > 0
        assert row["psnr_db"]["sd"] == pytest.approx(0, abs=1e-6), "both pairs are the same frame"
    assert rows["gradient"]["pcc"]["mean"] > rows["LenslessPiCam 1.0.8 ADMM, 100 rounds"]["pcc"]["mean"]
    assert len(facts["scores"]) == 6
    assert [left_out["pair"] for left_out in facts["left_out"]] == ["eye3"]


def test_bench_times_a_recording_without_truth(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "tutorial"
    write_tutorial(folder, scene)
    options = ("--method", "gradient", "--repeats", 1, "--peers", tmp_path / "none")
    assert run("bench", folder, *options, "--json", tmp_path / "b.json") == 0
    (row,) = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert (row["pairs"], row["psnr_db"]) == (1, None)
    assert "LenslessPiCam is left out: there is no" in capsys.readouterr().err
    assert run("bench", folder, "--method", "guess") == 2
    assert "there is no method 'guess'" in capsys.readouterr().err


def test_frontier_of_a_data_set_has_every_method_and_the_peer(
    scene: Scene, peers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pairs(tmp_path, scene)
    out = ("--json", tmp_path / "f.json", "--plot", tmp_path / "f.svg")
    assert run("frontier", "--data", tmp_path, "--repeats", 1, "--peers", peers, *out) == 0
    facts = json.loads((tmp_path / "f.json").read_text())
    assert facts["pairs"] == ["eye1", "eye2"]
    assert [left_out["pair"] for left_out in facts["left_out"]] == ["eye3"]
    assert {row["pairs"] for row in facts["rows"]} == {2}
    names = {row["method"] for row in facts["rows"]}
    assert names >= {*METHODS, "choice in budget", "LenslessPiCam 1.0.8 ADMM, 40 rounds"}
    seconds = [row["seconds_median"] for row in facts["rows"]]
    assert seconds == sorted(seconds)
    assert "own pairs, 2 pairs" in ElementTree.tostring(ElementTree.parse(tmp_path / "f.svg").getroot(), "unicode")
    assert "LenslessPiCam 1.0.8 ADMM, 10 rounds" in capsys.readouterr().out


def test_frontier_of_a_data_set_takes_no_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--json", tmp_path / "f.json", "--plot", tmp_path / "f.svg")
    assert run("frontier", "--data", tmp_path, "--raw", "raw.tiff", *out) == 2
    assert "--raw has no place" in capsys.readouterr().err


def test_the_peer_starts_again_after_a_failure(scene: Scene, peers: Path) -> None:
    with LenslessPeer(peers, (1, 2)) as peer:
        first = peer(scene.colour, scene.psf)
        assert [(result.name, result.picture.shape) for result in first] == [
            ("LenslessPiCam 1.0.8 ADMM, 1 rounds", scene.colour.shape),
            ("LenslessPiCam 1.0.8 ADMM, 2 rounds", scene.colour.shape),
        ]
        with pytest.raises(SettingError, match="LenslessPiCam ended with: no contrast"):
            peer(np.ones_like(scene.raw), scene.psf)
        assert np.allclose(peer(scene.raw, scene.psf)[0].picture, scene.raw / scene.raw.max())
