"""`diffuscope calibrations`: list, activation, signed export and import, and an imported PSF."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.config.head_file import CalibrationTable, InstrumentSpec, load_head
from device.errors import HeadMismatch
from device.head import HeadOpener
from services.cli import main
from tests.journey.conftest import Diffuscope
from tests.journey.test_reconstruct_options import caustic, mosaic_dng, write_dng
from tests.journey.wrong_inputs import call
from tests.project_files import ROOT
from tests.scenes import speckle
from tests.unit.test_archive import WHO, calibration

Say = Callable[..., str]
SHAPE = (96, 128)
WHOSE = ("--by", "Ana", "--source", "a laboratory")


@pytest.fixture
def run_command(capsys: pytest.CaptureFixture[str]) -> Say:
    """Return a function that runs a command and returns its output."""

    def run(*words: object) -> str:
        with pytest.raises(SystemExit) as ended:
            main(["calibrations", *map(str, words)])
        printed = capsys.readouterr()
        assert not ended.value.code, printed.err
        return printed.out

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Say:
    """Return a function that runs a command and returns its refusal: one sentence and one remedy."""

    def run(*words: object) -> str:
        with pytest.raises(SystemExit) as ended:
            main([*(["calibrations"] * (words[0] != "reconstruct")), *map(str, words)])
        printed = capsys.readouterr()
        assert (ended.value.code, printed.out, printed.err.count("\n")) == (2, "", 2), printed.err
        return printed.err

    return run


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Two calibrations of one head, the second active."""
    made = Archive(tmp_path / "archive")
    made.add_and_activate(calibration(), WHO)
    made.add_and_activate(calibration(65.0), WHO)
    return made


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_list_marks_the_active_calibration(archive, run_command):
    first, second = archive.ids()
    lines = run_command("list", "--archive", archive.root).splitlines()
    assert lines[0].startswith(f"  {first}  2026-11-21 09:30  DS-0042")
    assert "24.5 C  by Ana" in lines[0]
    assert "black 64.25 DN, white 4095 DN, gain 5.700 e-/DN, read noise 1.03 e-, 17 x 19 pixels, 2 PSFs" in lines[1]
    assert lines[2].strip() == "SIMULATED"
    assert lines[3].startswith(f"* {second}")
    assert len(lines) == 6


def test_earlier_calibration_is_reactivated(archive, run_command, refused):
    first, second = archive.ids()
    assert f"{first} is in force" in run_command("use", first, "--archive", archive.root)
    assert archive.active_id() == first
    assert f"{second} is in force" in run_command("use", second, "--archive", archive.root)
    assert "calibrations list" in refused("use", "0" * 16, "--archive", archive.root)
    assert "calibrations list" in refused("use", "../archive", "--archive", archive.root)
    assert archive.active_id() == second


def test_list_marks_a_damaged_calibration_and_keeps_the_others(archive, run_command, refused):
    first, second = archive.ids()
    (archive.root / second / "flat.npy").unlink()
    output = run_command("list", "--archive", archive.root)
    assert f"* {second}  DAMAGED: calibration {second}: flat.npy is missing\n    This calibration is damaged." in output
    assert f"  {first}  2026" in output
    assert "flat.npy is missing" in refused("show", second, "--archive", archive.root)
    (archive.root / second / "manifest.toml").unlink()
    (archive.root / "current").write_bytes(b"\xff" * 16)
    output = run_command("list", "--archive", archive.root)
    assert "manifest.toml is missing" in output
    assert "does not hold the name of a calibration\nChoose one with `diffuscope calibrations use`." in output
    run_command("use", first, "--archive", archive.root)
    assert archive.active_id() == first


def test_control_characters_of_a_manifest_are_escaped(archive, run_command):
    id = archive.add(calibration(66.0), replace(WHO, made_by="Eve\x1b[2J\n* forged", serial="\x1b]0;owned\x07"))
    for words in (("list",), ("show", id)):
        output = run_command(*words, "--archive", archive.root)
        assert not [letter for letter in output if letter != "\n" and not letter.isprintable()]
        assert "\n* forged" not in output


def test_empty_archive_is_reported(run_command, tmp_path):
    assert "no calibration is kept" in run_command("list", "--archive", tmp_path / "nowhere")


def test_calibration_is_exported_and_imported_as_a_signed_file(archive, run_command, refused, tmp_path):
    first, second = archive.ids()
    key, there = tmp_path / "key", Archive(tmp_path / "there")
    assert "is secret" in run_command("new-key", key, "--name", "Service centre")
    assert second in run_command("export", tmp_path / "one", "--archive", archive.root, "--key", key)
    assert first in run_command("export", first, tmp_path / "other", "--archive", archive.root, "--key", key)
    trusted = ("--archive", there.root, "--trust", f"{key}.pub")
    assert "signed by Service centre" in run_command("import", tmp_path / "one", *trusted)
    assert "no calibration is in force" in run_command("list", "--archive", there.root)
    assert f"{first} is in force" in run_command("import", tmp_path / "other", *trusted, "--use")
    assert there.load(second).provenance == WHO
    assert there.active_id() == first
    before = tree(there.root)
    whole = (tmp_path / "one").read_bytes()
    (tmp_path / "one").write_bytes(whole[:-1] + b"\1")
    (tmp_path / "two").write_bytes(whole)
    assert "damaged or changed" in refused("import", tmp_path / "one", *trusted)
    run_command("new-key", tmp_path / "stranger", "--name", "Service centre")
    stranger = ("--archive", there.root, "--trust", tmp_path / "stranger.pub")
    assert "a key that is not trusted here" in refused("import", tmp_path / "two", *stranger)
    assert tree(there.root) == before


def test_import_of_a_calibration_of_another_shape_is_refused(archive, run_command, refused, tmp_path):
    key, there = tmp_path / "key", tmp_path / "there"
    run_command("new-key", key, "--name", "Service centre")
    run_command("export", tmp_path / "one", "--archive", archive.root, "--key", key)
    head = ("--head", ROOT / "hardware/heads/sim.toml")
    output = refused("import", tmp_path / "one", "--archive", there, "--trust", f"{key}.pub", *head)
    assert "has 17 x 19 pixels, the head's file 1080 x 1920" in output
    assert not there.exists()
    assert "has 17 x 19 pixels" in refused("use", archive.ids()[0], "--archive", archive.root, "--head", "sim")
    assert archive.active_id() == archive.ids()[1]


# Imported PSF


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """A recording of others: 12-bit counts with a black level, a PSF, and a frame with it."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    psf, scene = speckle(SHAPE, 5), np.zeros(SHAPE)
    scene[40:60, 50:80] = 1.0
    spectrum = np.fft.rfft2(np.fft.ifftshift(psf))
    raw = np.fft.irfft2(np.fft.rfft2(scene) * spectrum, SHAPE)
    noise = np.random.default_rng(0).normal(0, 1.5, SHAPE)
    tifffile.imwrite(folder / "psf.tiff", np.rint(100 + 3000 * psf / psf.max()).astype(np.uint16))
    tifffile.imwrite(folder / "raw.tiff", np.rint(100 + 3000 * raw / raw.max() + noise).astype(np.uint16))
    return folder


def imported(run: Say, archive: Archive, *words: object) -> str:
    listing = run("import-psf", *words, "--archive", archive.root, "--by", "Ana", "--source", "DiffuserCam, 2018")
    return listing.split()[0]


def test_imported_psf_lists_its_unknown_values(run_command, theirs, tmp_path):
    archive = Archive(tmp_path / "archive")
    id = imported(run_command, archive, theirs / "psf.tiff", "--pitch-um", 6.5)
    kept = archive.load(id)
    assert kept.provenance.origin == "imported"
    assert kept.provenance.unknown == (
        "serial",
        "gain_e_per_dn",
        "read_noise_e",
        "geometry",
        "field_deg",
        "dark_dn",
        "flat",
        "bad",
        "black_dn",
        "white_dn",
    )
    assert dict(kept.provenance.figures)["pitch_um"] == 6.5
    output = run_command("show", id, "--archive", archive.root)
    assert "black unknown, white unknown, gain unknown, read noise unknown, 96 x 128 pixels" in output
    assert "IMPORTED from DiffuserCam, 2018, 10 things unknown" in output
    assert ["geometry", "unknown"] in [line.split() for line in output.splitlines()]
    border = np.median(kept.calibration.psfs[0].pixels[:2])
    assert abs(border) < 1e-9  # the black level of 100 counts would be a third of the light
    assert "no calibration is in force" in run_command("list", "--archive", archive.root)


def test_imported_psf_gives_the_same_picture_as_its_file(
    diffuscope: Diffuscope, environment: dict[str, str], run_command, theirs, tmp_path
):
    archive = Archive(tmp_path / "archive")
    id = imported(run_command, archive, theirs / "psf.tiff")
    before = tree(archive.root)
    for name, words in {
        "by_psf": ("--psf", theirs / "psf.tiff"),
        "by_id": ("--calibration", f"{archive.root}:{id}"),
    }.items():
        done = diffuscope("reconstruct", theirs / "raw.tiff", *words, "-o", tmp_path / f"{name}.npy")
        assert done.returncode == 0, done.stderr
    made, expected = np.load(tmp_path / "by_id.npy"), np.load(tmp_path / "by_psf.npy")
    assert np.array_equal(made, expected)
    assert made[42:58, 52:78].mean() > 5 * np.abs(made[:30]).mean()  # the bright rectangle keeps its position
    assert tree(archive.root) == before  # the FFT plans of this machine are stored elsewhere
    assert list(Path(environment["XDG_CACHE_HOME"]).rglob("fftw-*.wisdom"))


def test_active_calibration_is_used_and_invalid_names_are_refused(
    diffuscope: Diffuscope, run_command, refused, theirs, tmp_path
):
    archive = Archive(tmp_path / "a:b")
    run_command("use", imported(run_command, archive, theirs / "psf.tiff"), "--archive", archive.root)
    picture = tmp_path / "picture.png"
    raw = ("reconstruct", theirs / "raw.tiff", "-o", picture)
    assert diffuscope(*raw, "--calibration", archive.root).returncode == 0
    assert picture.stat().st_size > 500
    for words, expected in {
        (): "either PSFs or a calibration",
        ("--calibration", archive.root, "--psf", theirs / "psf.tiff"): "either PSFs or a calibration",
        ("--calibration", archive.root, "--head", "x.toml"): "says itself what it knows",
        ("--calibration", f"{archive.root}:0123456789abcdef"): "there is no calibration 0123456789abcdef",
        ("--calibration", tmp_path / "nowhere"): "no calibration is in force",
    }.items():
        assert expected in refused(*raw, *words)


def test_a_psf_of_a_mosaic_is_asked_as_a_raw_is(run_command, refused, tmp_path):
    """The pixels decide; a label alone is no mosaic, and --bayer none says so."""
    mono = write_dng(tmp_path / "mono.dng", caustic())
    answer = call(["calibrations", "import-psf", str(mono), "--archive", str(tmp_path / "a"), *WHOSE])
    assert answer.code == 0, answer.err
    assert "labelled as a colour mosaic (bggr), but its pixels are those of a monochrome sensor" in answer.err
    quiet = call(["calibrations", "import-psf", str(mono), "--archive", str(tmp_path / "a"), "--bayer", "none", *WHOSE])
    assert (quiet.code, quiet.err) == (0, "")
    mosaic = mosaic_dng(tmp_path / "mosaic.dng")
    kept = Archive(tmp_path / "b")
    assert "mosaic.dng is a colour mosaic (bggr)" in refused("import-psf", mosaic, "--archive", kept.root, *WHOSE)
    assert not kept.ids()


def test_stack_is_imported_as_one_calibration_with_its_dark_frame(run_command, refused, theirs, tmp_path):
    archive = Archive(tmp_path / "archive")
    counts = tifffile.imread(theirs / "psf.tiff")
    slope = np.linspace(0, 400, SHAPE[1])
    tifffile.imwrite(theirs / "tilted.tiff", (counts + slope).astype(np.uint16))
    tifffile.imwrite(theirs / "dark.tiff", np.broadcast_to(100 + slope, SHAPE).astype(np.uint16))
    tifffile.imwrite(theirs / "small.tiff", counts[:50])
    both = archive.load(imported(run_command, archive, theirs / "psf.tiff", theirs / "psf.tiff")).calibration
    assert len(both.psfs) == 2
    cleaned = imported(run_command, archive, theirs / "tilted.tiff", "--dark", theirs / "dark.tiff")
    found = archive.load(cleaned).calibration.psfs[0].pixels
    assert np.corrcoef(found.ravel(), both.psfs[0].pixels.ravel())[0, 1] > 0.999
    words = ("--archive", archive.root, "--by", "Ana", "--source", "x")
    assert "96 x 128" in refused("import-psf", theirs / "psf.tiff", theirs / "small.tiff", *words)
    assert "dark frame" in refused("import-psf", theirs / "psf.tiff", "--dark", theirs / "small.tiff", *words)
    assert "cannot be read" in refused("import-psf", theirs / "absent.tiff", *words)


def test_saturated_psf_is_refused_with_the_lost_share(run_command, refused, theirs, tmp_path):
    counts = tifffile.imread(theirs / "psf.tiff")
    words = ("--archive", tmp_path / "archive", "--by", "Ana", "--source", "x")
    tifffile.imwrite(theirs / "clipped.tiff", np.minimum(3 * counts, 4095).astype(np.uint16))
    np.save(theirs / "clipped.npy", np.minimum(counts / 3100, 0.4).astype(np.float32))
    for name in ("clipped.tiff", "clipped.npy"):
        output = refused("import-psf", theirs / name, *words)
        assert f"{name} is saturated" in output
        assert "% of its light" in output
    assert "is saturated" in refused("import-psf", theirs / "psf.tiff", "--white-dn", 1000, *words)
    assert not (tmp_path / "archive").exists()


def test_head_accepts_an_imported_psf_only_if_its_file_allows(run_command, theirs, tmp_path):
    archive = Archive(tmp_path / "archive")
    bare = imported(run_command, archive, theirs / "psf.tiff")
    full = imported(run_command, archive, theirs / "psf.tiff", "--black-dn", 100, "--white-dn", 4095)
    head = load_head(ROOT / "hardware/heads/imx296.toml")
    camera = head.camera.model_copy(update={"rows": SHAPE[0], "cols": SHAPE[1]})

    def opening(imported: bool) -> InstrumentSpec:
        table = CalibrationTable(archive=archive.root, imported=imported)
        return head.model_copy(update={"camera": camera, "sim": None, "calibration": table})

    for id, allowed, expected in ((full, False, "not measured on this head"), (bare, True, "black_dn and white_dn")):
        archive.activate(id)
        with HeadOpener(opening(allowed), VirtualClock()) as opened, pytest.raises(HeadMismatch, match=expected):
            opened.calibration()
    archive.activate(full)
    with HeadOpener(opening(True), VirtualClock()) as opened:
        assert opened.calibration().sensor.white_dn == 4095


def test_export_takes_an_id_and_a_file_only(archive, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["calibrations", "export", "a", "b", "c", "--archive", str(archive.root), "--key", "k"])
    assert ended.value.code == 2
    assert "one calibration and one file" in capsys.readouterr().err
