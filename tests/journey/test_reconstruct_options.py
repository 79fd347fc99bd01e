"""`diffuscope reconstruct`: bin, rounds and settings, several raws, channels, mosaics and stacks, on tiny frames."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from device.config.bayer import mosaic_of
from device.config.image_files import read_image
from device.recon.assessment.psf_consistency import Match
from device.recon.assessment.quality_figures import Audience, quality_warnings
from services.research.reconstruct_file import FileReconstructor, reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions, concentration
from tests.journey.wrong_inputs import SHAPE, Answer, call, caustic, reconstruct, scene, write_right_inputs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    write_right_inputs(folder)
    return folder


def refusal(answer: Answer) -> str:
    assert answer.code == 2, answer.err
    assert len(answer.err.strip().splitlines()) == 2
    return answer.err


def options(psfs: Iterable[Any], **changes: Any) -> ReconstructOptions:
    return ReconstructOptions(psfs=tuple(psfs), **{"method": "gradient", "bin": 1} | changes)


def test_bin_rounds_and_settings_are_used_and_reported(folder: Path) -> None:
    report = folder / "r.json"
    answer = call(reconstruct(folder, "--bin", "2", "--rounds", "3", "--set", "tau=0.5", "--report", str(report)))
    assert answer.code == 0, answer.err
    assert "open, bin 2, solved on 48 x 64 by FFTW, " in answer.out
    facts = json.loads(report.read_text())
    assert (facts["bin"], facts["rounds"], facts["solved"]) == (2, 3, [48, 64])
    assert facts["regularisation"]["tau"] == 0.5
    assert facts["given"] == {"bin": 2, "rounds": 3, "settings": {"tau": 0.5}}


@pytest.mark.parametrize(("method", "setting"), [("tikhonov", "mu"), ("gradient", "mu"), ("evidence", "prior_slope")])
def test_setting_replaces_the_value_of_the_frame(method: str, setting: str) -> None:
    own = reconstruct_file(scene(), options([caustic()], method=method))
    value = float(own.report.regularisation[setting])
    same, other = (
        reconstruct_file(scene(), options([caustic()], method=method, settings={setting: given}))
        for given in (value, 2 * value + 1)
    )
    assert np.allclose(same.picture, own.picture, atol=1e-4 * own.picture.max())
    assert not np.allclose(other.picture, own.picture, atol=1e-2 * own.picture.max())
    assert other.report.regularisation[setting] == 2 * value + 1


def test_an_overexposed_frame_gives_one_picture_whatever_its_ceiling() -> None:
    clipped = np.minimum(scene(), 1023)  # 5 % of the pixels
    as_stored = reconstruct_file(clipped, options([caustic()]))
    for scale, black_dn in ((1.0, 15), (1 / 1023, 0)):
        other = (clipped - np.minimum(clipped, black_dn)) * scale
        made = reconstruct_file(other.astype(np.float32 if scale < 1 else np.uint16), options([caustic()]))
        assert made.report.warnings == as_stored.report.warnings
        assert any("saturated and were left out" in warning for warning in made.report.warnings)
        agreement = np.corrcoef(made.picture.ravel(), as_stored.picture.ravel())[0, 1]
        assert agreement > 0.99  # the black level and the noise of the estimate differ; with the clipped pixels 0.9


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--method", "variation", "--set", "mu=1"], "Its settings are: tau, prior_slope, prior_log_power."),
        (["--set", "tau=-1"], "Give tau a value from 1e-12 to 1e+12"),
        (["--set", "tau"], "KEY=VALUE"),
        (["--set", "tau=much"], "KEY=VALUE"),
        (["--bin", "0"], "a bin of 0"),
        (["--bin", "9"], "Give --bin from 1 to 6."),
        (["--rounds", "0"], "0 rounds"),
        (["--rounds", "5", "--method", "gradient"], "closed form"),
        (["--bayer", "rgbg"], "Choose one of: rggb, bggr, grbg, gbrg, none."),
        (["FOLDER/psf.npy"], "A stack of PSFs is --psf A --psf B"),
        (["--sweep", "FOLDER/s.svg"], "compares several PSFs"),
        (["-o", "FOLDER/raw.npy"], "would be overwritten"),
        (["--each"], "Give -o FOLDER/."),
        (["--each", "-o", "FOLDER/v1.2", "--bin", "99"], "Give --bin from 1 to 6."),
        (["--each", "-o", "FOLDER/v1.2", "--sweep", "FOLDER/s.svg"], "Leave --sweep or --each out."),
    ],
)
def test_wrong_option_is_refused(folder: Path, words: list[str], message: str) -> None:
    given = reconstruct(folder, *(word.replace("FOLDER", str(folder)) for word in words))
    assert message in refusal(call(given))


def test_each_raw_gets_a_picture_and_a_failed_one_is_named(folder: Path) -> None:
    np.save(folder / "b.npy", scene()[:, ::-1])
    np.save(folder / "black.npy", np.zeros(SHAPE, np.uint16))
    raws = [str(folder / name) for name in ("raw.npy", "black.npy", "b.npy")]
    out, reports = folder / "pictures", folder / "reports"
    psf = ["--psf", str(folder / "psf.npy"), "--method", "gradient"]
    answer = call(["reconstruct", "--each", *raws, *psf, "-o", f"{out}/", "--report", f"{reports}/"])
    assert answer.code == 1
    assert {path.name for path in out.iterdir()} == {"raw.tiff", "b.tiff"}
    assert {path.name for path in reports.iterdir()} == {"raw.json", "b.json"}
    assert "error: black.npy: " in answer.err
    assert "no signal" in answer.err
    assert "3/3 done, 0 s left" in answer.err
    assert len(answer.out.splitlines()) == 2
    single = call(["reconstruct", raws[2], *psf, "-o", str(folder / "single.tiff")])
    assert single.code == 0
    assert np.allclose(read_image(out / "b.tiff"), read_image(folder / "single.tiff"), rtol=1e-4, atol=1e-3)


def test_each_refuses_pictures_that_would_replace_a_file(folder: Path) -> None:
    (folder / "copy").mkdir()
    np.save(folder / "copy" / "raw.npy", scene())
    raws = [str(folder / "raw.npy"), str(folder / "copy" / "raw.npy")]
    words = ["reconstruct", "--each", *raws, "--psf", str(folder / "psf.npy"), "-o", str(folder / "out2")]
    assert "would be written for two raws" in refusal(call(words))


def test_reconstructor_plans_once_for_frames_of_equal_levels() -> None:
    reconstructor = FileReconstructor(options([caustic()]))
    first, second = reconstructor(scene()), reconstructor(scene()[::-1].copy())
    assert second.report.seconds["solve"] < 1
    assert not np.allclose(first.picture, second.picture)
    assert np.array_equal(first.picture, reconstructor(scene()).picture)


def test_colour_psf_is_used_per_channel() -> None:
    psfs = [caustic(), caustic()[::-1], caustic()[:, ::-1]]
    raws = [scene(), scene()[::-1], scene()[:, ::-1]]
    made = reconstruct_file(np.dstack(raws), options([np.dstack(psfs)]))
    assert made.report.psf_channels == 3
    for c in range(3):
        single = reconstruct_file(raws[c], options([psfs[c]]))
        assert np.allclose(made.picture[..., c], single.picture, atol=2e-2 * single.picture.max())


def test_mosaic_is_solved_in_planes() -> None:
    smooth = ndimage.gaussian_filter(np.dstack([scene() * share for share in (1.0, 0.6, 0.3)]), (2, 2, 0))
    psf = ndimage.gaussian_filter(caustic().astype(np.float32), 2)
    mosaic = np.rint(mosaic_of(smooth, "grbg")).astype(np.uint16)
    made = reconstruct_file(mosaic, options([psf], bayer="grbg"))
    assert made.picture.shape == (*SHAPE, 3)
    assert (made.report.bayer, made.report.solved) == ("grbg", (48, 64))
    red, green, blue = made.picture.reshape(-1, 3).mean(axis=0)
    assert green / red == pytest.approx(0.6, abs=0.05)
    assert blue / red == pytest.approx(0.3, abs=0.05)


def write_dng(path: Path, counts: Any, shift: int = 0) -> Path:
    """Write counts as picamera2 does, labelled as a mosaic, with a black level of 64; `shift`: left-justified."""
    levels = [(50714, "I", 1, 64 << shift, True), (50717, "I", 1, (4096 << shift) - 1, True)]
    tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\2\1\1\0", True), *levels]
    tifffile.imwrite(path, (counts + 64) << shift, photometric="cfa", extratags=tags)
    return path


def mosaic_dng(path: Path, shift: int = 0) -> Path:
    """Write the scene as the mosaic of a colour sensor, and return the path."""
    colours = np.dstack([ndimage.gaussian_filter(scene() * share, 2) for share in (1.0, 0.6, 0.3)])
    return write_dng(path, np.rint(mosaic_of(colours, "bggr")).astype(np.uint16), shift)


@pytest.mark.parametrize("shift", [0, 4])
def test_label_of_a_mosaic_is_believed_only_with_the_pixels_of_one(tmp_path: Path, shift: int) -> None:
    mosaic = mosaic_dng(tmp_path / "mosaic.dng", shift)
    mono = write_dng(tmp_path / "mono.dng", scene(), shift)
    assert reconstruct_file(mosaic, options([caustic()])).report.bayer == "bggr"
    for given, label in ((None, None), ("none", None), ("bggr", "bggr")):
        made = reconstruct_file(mono, options([caustic()], bayer=given))
        assert made.report.bayer == label
        noted = any("labelled as a colour mosaic (bggr)" in warning for warning in made.report.warnings)
        assert noted == (given is None)
    picture = reconstruct_file(mono, options([caustic()])).picture
    expected = reconstruct_file(scene(), options([caustic()])).picture
    assert np.corrcoef(picture.ravel(), expected.ravel())[0, 1] > 0.999
    forced = reconstruct_file(mosaic, options([caustic()], bayer="none"))
    assert forced.picture.ndim == 2
    assert not any("mosaic" in warning for warning in forced.report.warnings)


def test_black_level_of_a_dng_is_no_light_of_its_flat_frame(tmp_path: Path) -> None:
    falloff = np.linspace(400, 2400, SHAPE[1])[None] + np.zeros(SHAPE)
    raw = write_dng(tmp_path / "raw.dng", np.rint(scene() * falloff / 2400).astype(np.uint16))
    flat = write_dng(tmp_path / "flat.dng", np.rint(falloff).astype(np.uint16))
    made = reconstruct_file(raw, options([caustic()], flat=flat, bayer="none")).picture
    expected = reconstruct_file(scene(), options([caustic()])).picture
    assert np.corrcoef(made.ravel(), expected.ravel())[0, 1] > 0.999


def test_stack_in_one_file_is_a_choice_of_depths(folder: Path) -> None:
    stack = np.stack([caustic()[::-1], caustic(), caustic()[:, ::-1]])
    np.save(folder / "stack.npy", stack)
    answer = call(reconstruct(folder, "--report", str(folder / "stack.json"), psf="stack.npy"))
    assert answer.code == 0
    assert json.loads((folder / "stack.json").read_text())["psf_index"] == 1


@pytest.mark.parametrize(
    "quality",
    [
        {"saturated": 0.1},
        {"saturated": 0.0, "through": 0.1},
        {"saturated": 0.0, "coverage": 0.5},
        {"saturated": 0.0, "banding": 0.1},
    ],
)
def test_rules_are_one_and_files_have_words_of_their_own(quality: dict[str, float | None]) -> None:
    operator, files = (quality_warnings(quality, Match.UNKNOWN, None, audience) for audience in Audience)
    assert len(operator) == len(files) == 1
    assert operator != files
    for word in ("again", "eye", "look", "pupil", "Move"):
        assert word not in files[0]


def test_psf_is_more_concentrated_than_its_frame() -> None:
    assert concentration(caustic()) > 1.3 * concentration(scene())
