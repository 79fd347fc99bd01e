"""Commands `methods`, `simulate`, `reconstruct` and `run`, in real processes where needed, else in this process."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from device.config.image_files import read_image
from device.errors import InputError
from services.cli import main
from services.http.server import bind_socket
from services.research.reconstruct_file import FileReconstruction, OutputFiles, reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions
from tests.journey.conftest import Diffuscope
from tests.progress_lines import without_progress

REPORT_KEYS = {  # the public interface
    "method",
    "bin",
    "rounds",
    "stopped",
    "seconds",
    "psf_index",
    "psf_scale",
    "psf_cylinder",
    "refraction_dpt",
    "refraction_scatter",
    "regularisation",
    "noise_dn",
    "residual",
    "quality",
    "warnings",
    "solved",
    "given",
    "psf_channels",
    "bayer",
    "frames",
    "channels",
    "simulated",
}


@pytest.fixture(scope="module")
def scene(diffuscope: Diffuscope, head_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated frame with its truth and PSF."""
    folder = tmp_path_factory.mktemp("scene")
    done = diffuscope("simulate", head_file, "-o", folder)
    assert done.returncode == 0, done.stderr
    return folder


Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Return a function that runs a command and returns its refusal: one sentence and one remedy on stderr."""

    def run(*words: object) -> str:
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        printed = capsys.readouterr()
        assert ended.value.code == 2
        assert printed.out == ""
        lines = without_progress(printed.err).strip().splitlines()
        assert lines[0].startswith("error: "), printed.err
        assert len(lines) == 2, printed.err
        return printed.err

    return run


def test_methods_are_listed_with_cost(diffuscope: Diffuscope) -> None:
    done = diffuscope("methods", "--rows", 270, "--cols", 480)
    assert done.returncode == 0
    assert "270 x 480" in done.stdout
    assert "tikhonov" in done.stdout
    assert done.stdout.count("(default)") == 1
    assert done.stderr == ""


def test_simulate_writes_the_simulated_frame(scene: Path) -> None:
    assert {path.name for path in scene.iterdir()} >= {"raw.tiff", "truth.npy", "psf.tiff", "plan.json"}
    for name in ("raw.tiff", "truth.npy", "psf.tiff"):
        assert read_image(scene / name).shape == (270, 480)
    assert read_image(scene / "raw.tiff").dtype == np.uint16
    plan = json.loads((scene / "plan.json").read_text())
    assert plan["shot"]["simulated"] is True


def test_reconstruct_writes_picture_and_report(
    diffuscope: Diffuscope, scene: Path, head_file: Path, tmp_path: Path
) -> None:
    out, report = tmp_path / "x.npy", tmp_path / "r.json"
    done = diffuscope(
        "reconstruct",
        scene / "raw.tiff",
        "--psf",
        scene / "psf.tiff",
        "--head",
        head_file,
        "-o",
        out,
        "--report",
        report,
    )
    assert done.returncode == 0, done.stderr
    assert str(out) in done.stdout
    picture, truth = read_image(out), read_image(scene / "truth.npy")
    assert picture.dtype == np.float32
    assert picture.shape == truth.shape
    seen = truth > 0
    assert np.corrcoef(picture[seen], truth[seen])[0, 1] > 0.8
    facts = json.loads(report.read_text())
    assert set(facts) == REPORT_KEYS
    assert facts["simulated"] is True
    assert facts["stopped"] == "done"
    assert all(seconds >= 0 for seconds in facts["seconds"].values())


def made_from(scene: Path, plans: Path, output: Path, raw: Path | None = None, **changes: Any) -> FileReconstruction:
    """Return the picture of a raw, by default that of the scene, which is written to `output`."""
    options = ReconstructOptions(psfs=(scene / "psf.tiff",), plans=plans, **{"method": "gradient"} | changes)
    return reconstruct_file(raw or scene / "raw.tiff", options, OutputFiles(output))


def test_tiff_npy_and_png_hold_the_same_picture(scene: Path, plans: Path, tmp_path: Path) -> None:
    for ending in ("npy", "tiff", "png"):
        made_from(scene, plans, tmp_path / f"x.{ending}")
    exact, tiff = read_image(tmp_path / "x.npy"), read_image(tmp_path / "x.tiff")
    assert tiff.dtype == np.float32
    assert np.allclose(tiff, exact, rtol=1e-5, atol=1e-5 * np.abs(exact).max())
    eyes = read_image(tmp_path / "x.png").astype(float)
    assert eyes.shape == exact.shape == (270, 480)
    above = slice(0, 200)  # the band SIMULATED lies below, as in the raw
    assert np.corrcoef(eyes[above].ravel(), exact[above].ravel())[0, 1] > 0.9


@pytest.mark.parametrize("ending", ["npy", "tiff"])
def test_three_channels_are_kept(scene: Path, plans: Path, tmp_path: Path, ending: str) -> None:
    grey = read_image(scene / "raw.tiff")
    colour = np.stack([grey, grey // 2 + 32, grey // 4 + 48], axis=2)
    np.save(tmp_path / "raw.npy", colour)
    out = tmp_path / f"x.{ending}"
    made_from(scene, plans, out, raw=tmp_path / "raw.npy")
    picture = read_image(out)
    assert picture.shape == (270, 480, 3)
    means = picture.reshape(-1, 3).mean(axis=0)
    assert means[0] > means[1] > means[2]


def test_budget_is_kept_and_an_invalid_one_refused(scene: Path, plans: Path, tmp_path: Path, refused: Refused) -> None:
    made = made_from(scene, plans, tmp_path / "x.npy", budget_s=1e-6)
    assert made.report.stopped == "deadline"
    assert made.report.bin > 1
    assert read_image(tmp_path / "x.npy").shape == (270, 480)
    for budget in ("0", "-1", "nan", "inf"):
        words = refused(*reconstruct(scene, tmp_path), "--budget-s", budget)
        assert f"a budget of {float(budget)} s is not a time" in words
        assert "positive" in words


def test_simulated_mark_is_kept(scene: Path, head_file: Path, plans: Path, tmp_path: Path) -> None:
    made = made_from(scene, plans, tmp_path / "x.png", head=head_file)
    assert made.simulated is True
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.text["simulated"] == "true"  # type: ignore[attr-defined]


def reconstruct(scene: Path, tmp_path: Path) -> list[object]:
    return ["reconstruct", scene / "raw.tiff", "--psf", scene / "psf.tiff", "-o", tmp_path / "out.npy"]


@pytest.fixture(scope="module")
def broken(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of files whose content does not fit their names."""
    folder = tmp_path_factory.mktemp("broken")
    psf = read_image(scene / "psf.tiff").astype(np.float64)
    raw = read_image(scene / "raw.tiff")
    nan = psf.copy()
    nan[5, 5] = np.nan
    for name, array in {
        "nan": nan,
        "zero": 0 * psf,
        "negative": -psf,
        "small": psf[::2, ::2],
        "line": psf[0],
        "stack": psf[None, None],
        "half": raw[::2],
        "signed": raw.astype(np.int32) - 1000,
        "allnan": np.full(raw.shape, np.nan),
        "full": np.full(raw.shape, 65535, np.uint16),
    }.items():
        np.save(folder / f"{name}.npy", array)
    whole = (scene / "raw.tiff").read_bytes()
    (folder / "cut.tiff").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.tiff").touch()
    (folder / "text.png").write_text("a letter, not a picture\n" * 50)
    (folder / "old.bmp").write_bytes(b"BM")
    return folder


BAD_RAWS = {
    "none.tiff": "No such file",
    "cut.tiff": "is not a whole tiff",
    "empty.tiff": "is empty",
    "text.png": "is not a whole png",
    "old.bmp": "'.bmp' is not one of",
    "line.npy": "rows and columns",
    "stack.npy": "rows and columns",
    "signed.npy": "negative",
    "allnan.npy": "cannot be used|marked bad",
    "half.npy": "the raw 135 x 480",
}


@pytest.mark.parametrize("name", BAD_RAWS)
def test_unusable_raw_is_refused(scene: Path, broken: Path, tmp_path: Path, refused: Refused, name: str) -> None:
    words = reconstruct(scene, tmp_path)
    words[1] = broken / name
    refusal = refused(*words)
    assert any(part in refusal for part in BAD_RAWS[name].split("|")), refusal
    assert not (tmp_path / "out.npy").exists()


BAD_PSFS = {
    "none.tiff": "No such file",
    "nan.npy": "not numbers",
    "zero.npy": "positive sum",
    "negative.npy": "positive sum",
    "small.npy": "small.npy has 135 x 240 pixels, the raw 270 x 480",
    "line.npy": "rows and columns",
    "stack.npy": "rows and columns",
    "empty.tiff": "is empty",
    "text.png": "is not a whole png",
    "signed.npy": "negative",
}


@pytest.mark.parametrize("name", BAD_PSFS)
def test_unusable_psf_is_refused(scene: Path, broken: Path, tmp_path: Path, refused: Refused, name: str) -> None:
    words = reconstruct(scene, tmp_path)
    words[3] = broken / name
    assert BAD_PSFS[name] in refused(*words)
    words[3] = scene / "psf.tiff"
    assert BAD_PSFS[name] in refused(*words, "--psf", broken / name)  # also within a stack


@pytest.mark.parametrize("option", ["--dark", "--flat"])
def test_dark_or_flat_of_another_size_is_refused(
    scene: Path, broken: Path, tmp_path: Path, refused: Refused, option: str
) -> None:
    refusal = refused(*reconstruct(scene, tmp_path), option, broken / "half.npy")
    assert "half.npy has 135 x 480 pixels, the raw 270 x 480" in refusal
    assert "same camera mode" in refusal


WRONG_OPTIONS: dict[str, tuple[list[str], str]] = {
    "unknown method": (["--method", "magic"], "Choose one of: "),
    "field without head": (["--field-deg", "30"], "--head"),
    "missing head": (["--head", "nowhere.toml"], "nowhere.toml cannot be read"),
    "no folder": (["-o", "nowhere/x.npy"], "folder that does not exist"),
    "a folder": (["-o", "/"], "written as"),
    "no such kind": (["-o", "x.jpeg"], "written as .npy, .tiff or .png"),
    "no folder for the report": (["--report", "nowhere/r.json"], "folder that does not exist"),
}


@pytest.mark.parametrize("what", WRONG_OPTIONS)
def test_invalid_option_is_refused_with_the_valid_ones(
    scene: Path, tmp_path: Path, refused: Refused, what: str
) -> None:
    options, words = WRONG_OPTIONS[what]
    assert words in refused(*reconstruct(scene, tmp_path), *options)


@pytest.mark.parametrize("field_deg", ["0", "-5", "nan", "180"])
def test_impossible_field_is_refused(
    scene: Path, head_file: Path, tmp_path: Path, refused: Refused, field_deg: str
) -> None:
    words = refused(*reconstruct(scene, tmp_path), "--head", head_file, "--field-deg", field_deg)
    assert "cannot be lit" in words


def test_typo_in_a_head_file_is_reported_with_key_line_and_suggestion(
    head_file: Path, tmp_path: Path, refused: Refused
) -> None:
    text = head_file.read_text().replace("pitch_um", "pich_um")
    typo = tmp_path / "typo.toml"
    typo.write_text(text)
    line = 1 + text.splitlines().index("pich_um = 20.16")
    for words in (["run", "--head"], ["simulate", "-o", tmp_path / "out"]):
        refusal = refused(*words, typo)
        assert f"line {line}" in refusal
        assert "'camera.pich_um' is not a known key; did you mean 'pitch_um'?" in refusal


def test_refusal_of_a_process_is_two_lines_and_exit_code_2(diffuscope: Diffuscope, scene: Path, tmp_path: Path) -> None:
    done = diffuscope(*reconstruct(scene, tmp_path), "--method", "magic")
    assert done.returncode == 2
    assert done.stdout == ""
    printed = without_progress(done.stderr)
    assert printed == "error: there is no method 'magic'\nChoose one of: " + printed.split(": ", 2)[2]


def test_occupied_port_is_reported_before_the_head_is_opened(head_file: Path, refused: Refused, tmp_path: Path) -> None:
    with bind_socket("127.0.0.1", 0) as taken:  # like another instance during its start
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match="cannot be served") as error:
            bind_socket("127.0.0.1", port)
    assert f"--port {port + 1}" in error.value.remedy


def test_foreign_address_has_another_remedy() -> None:
    for host in ("192.0.2.1", "no.such.host.invalid"):
        with pytest.raises(InputError, match="cannot be served") as error:
            bind_socket(host, 8000)
        assert "--host" in error.value.remedy
        assert "Another program" not in error.value.remedy
