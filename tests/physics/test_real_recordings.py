"""Published lensless recordings without a known field: accuracy of the default methods on real light."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from device.calibration.archive import Archive, Provenance
from device.calibration.import_psf import ImportedPsfInfo, read_imported_psf
from device.clock import SystemClock
from device.config.image_files import as_raw, read_image, read_psf
from device.recon.assessment.psf_consistency import Match, PsfConsistency
from device.recon.estimation.psf_selection import most_likely_psf
from device.recon.model.fft_plans import Planner
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe, default_schedule
from device.values import Calibration, Image, Psf, Sensor
from services.research.benchmark import BenchmarkRequest, benchmark
from services.research.datasets import open_dataset
from services.research.reconstruct_file import reconstruct_file
from services.research.reconstruct_inputs import ReconstructOptions
from tests.wrong_psfs import orientations, resized, shuffled

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "lensless"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"there are no recordings in {DATA}"),
]
PLANNER = Planner(folder=None, threads=1, effort="FFTW_ESTIMATE")


def loaded(raw: str, psf: str) -> tuple[np.ndarray, Calibration]:
    frame = as_raw(read_image(DATA / raw))
    return frame.pixels, Calibration((read_psf(DATA / psf),), Sensor(white_dn=frame.white_dn), bad=frame.bad)


def butterfly(name: str, *recipes: Recipe, scale: float = 1.0) -> Image:
    pixels, calibration = loaded(f"dlmd/diffuser/{name}.npy", "dlmd/derived_psf_480x270_f32.npy")
    scaled = (pixels * np.float32(scale)).astype(np.float32)
    return Reconstructor(calibration, pixels.shape[:2], PLANNER, SystemClock(), recipes)(scaled).picture


def psnr_db(picture: Image, name: str) -> float:
    """Return the PSNR against the lensed truth: the authors' crop, one gain per channel, clipped to 0..1."""
    truth = np.load(DATA / f"dlmd/lensed/{name}.npy")[0:210, 62:442].astype(np.float64)
    x = picture[0:210, 62:442].astype(np.float64)
    x *= (x * truth).sum(axis=(0, 1)) / (x * x).sum(axis=(0, 1))
    return float(-10 * np.log10(np.mean((np.clip(x, 0, 1) - truth) ** 2)))


def test_default_schedule_without_a_field_ends_with_open() -> None:
    pixels, calibration = loaded("dlmd/diffuser/im65.npy", "dlmd/derived_psf_480x270_f32.npy")
    quick, full = default_schedule(calibration, pixels.shape[:2])
    assert (quick.method, full) == ("gradient", Recipe("open", 2))


# A hundred rounds of LenslessPiCam's ADMM take 9 s; sixty rounds of `open` take under a second.
@pytest.mark.parametrize(("name", "peer_db"), [("im65", 18.16), ("im326", 21.60), ("im43", 14.72)])
def test_psnr_is_at_least_that_of_lenslesspicam(name: str, peer_db: float) -> None:
    assert psnr_db(butterfly(name), name) >= peer_db


def test_psnr_rises_with_the_rounds() -> None:
    by_round = [psnr_db(butterfly("im43", Recipe("open", 2, rounds)), "im43") for rounds in (5, 20, 60)]
    assert by_round == sorted(by_round)
    assert by_round[0] > psnr_db(butterfly("im43", Recipe("gradient", 2)), "im43")


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_picture_scales_with_the_units_of_the_frame(scale: float) -> None:
    unit, scaled = butterfly("im65", Recipe("open", 4)), butterfly("im65", Recipe("open", 4), scale=scale)
    assert np.abs(scaled / scale - unit).max() < 0.02 * unit.max()


def imported_calibration(folder: Path, *psfs: str) -> Calibration:
    """Return the calibration of published PSFs after import into an archive."""
    found, archive = read_imported_psf(tuple(DATA / psf for psf in psfs), ImportedPsfInfo()), Archive(folder)
    when = datetime(2026, 11, 21, tzinfo=UTC)
    provenance = Provenance(
        "unknown", when, "a test", "0", None, found.figures, "imported", "DiffuserCam", found.unknown
    )
    return archive.load(archive.add(found.calibration, provenance)).calibration


def test_the_hand_has_no_streaks(tmp_path: Path) -> None:
    pixels, by_file = loaded("tutorial/rawdata_hand_sample.tif", "tutorial/psf_sample.tif")
    calibration = replace(
        imported_calibration(tmp_path, "tutorial/psf_sample.tif"), sensor=by_file.sensor, bad=by_file.bad
    )
    picture = Reconstructor(calibration, pixels.shape, PLANNER, SystemClock(), (Recipe("open", 8),))(pixels).picture
    bright = float(np.percentile(picture, 99))
    # the closed form leaves streaks across the frame, 0.3 of the hand; above and left of the hand it is dark
    assert np.percentile(picture[:300], 95) < 0.1 * bright
    assert np.percentile(picture[:, :350], 95) < 0.1 * bright


def test_the_bars_of_the_target_are_resolved(tmp_path: Path) -> None:
    pixels, _ = loaded("diffusercam3d/example_raw.png", "diffusercam3d/psf/psf16.tiff")
    calibration = imported_calibration(
        tmp_path, *(f"diffusercam3d/psf/psf{depth:02}.tiff" for depth in range(0, 44, 4))
    )
    index, scores = most_likely_psf(calibration, pixels, PLANNER)
    assert (len(scores), calibration.psfs[index].name) == (11, "psf16.tiff")
    make = Reconstructor(calibration, pixels.shape, PLANNER, SystemClock(), (Recipe("open", 1),), index)
    picture = make(pixels).picture
    assert picture[80:195, 115:215].sum() > 0.9 * picture.sum()
    across = picture[140:150, 168:186].mean(axis=0)  # three bars of the group in focus
    inner = across[1:-1]
    peaks = inner[(inner > across[:-2]) & (inner >= across[2:]) & (inner > 0.5 * across.max())]
    dips = inner[(inner < across[:-2]) & (inner <= across[2:])]
    assert len(peaks) == 3
    assert np.sort(dips)[:2].max() < 0.6 * peaks.min()


HAND = ("tutorial/rawdata_hand_sample.tif", "tutorial/psf_sample.tif")
TARGET = ("diffusercam3d/example_raw.png", "diffusercam3d/psf/psf16.tiff")  # the depth that `most_likely_psf` chooses
BUTTERFLIES = [(f"dlmd/diffuser/{name}.npy", "dlmd/derived_psf_480x270_f32.npy") for name in ("im43", "im326", "im65")]
RECORDINGS = [HAND, TARGET, *BUTTERFLIES]


def match(pixels: np.ndarray, calibration: Calibration, psf: Image) -> Match:
    found = PsfConsistency(replace(calibration, psfs=(Psf(psf),)), pixels.shape[:2])(pixels)
    assert found is not None
    return found.match


@pytest.mark.parametrize(("raw", "psf"), RECORDINGS)
def test_a_psf_is_consistent_with_its_own_recording_and_no_wrong_psf_is(raw: str, psf: str) -> None:
    pixels, calibration = loaded(raw, psf)
    right = calibration.psfs[0].pixels
    assert match(pixels, calibration, right) is Match.CONSISTENT
    found = {kind: match(pixels, calibration, wrong) for kind, wrong in orientations(right).items()}
    assert found == {
        "mirrored left-right": Match.MIRRORED_LEFT_RIGHT,
        "mirrored up-down": Match.MIRRORED_UP_DOWN,
        "rotated by 180": Match.ROTATED,
    }
    assert match(pixels, calibration, shuffled(right)) is Match.FOREIGN
    for _, other in RECORDINGS:
        if other != psf:
            foreign = resized(read_psf(DATA / other).pixels, calibration.psfs[0].shape)
            assert match(pixels, calibration, foreign) is Match.FOREIGN


def test_the_command_warns_of_a_rotated_psf_and_of_a_target_in_several_depths_only(tmp_path: Path) -> None:
    """No single depth explains the tilted target: 7.8 times the noise is left."""
    depths = tuple(sorted((DATA / "diffusercam3d/psf").glob("psf*.tiff")))
    (left,) = psf_warnings(tmp_path, DATA / TARGET[0], *depths)
    assert left.startswith("The residual is 7.8 times the noise")
    assert psf_warnings(tmp_path, DATA / HAND[0], DATA / HAND[1]) == ()
    for raw, psf in BUTTERFLIES[:1]:
        assert psf_warnings(tmp_path, DATA / raw, DATA / psf) == ()
        turned = tmp_path / "turned.npy"
        np.save(turned, np.load(DATA / psf)[::-1, ::-1])
        (words,) = psf_warnings(tmp_path, DATA / raw, turned)
        assert words.startswith("The PSF is rotated by 180 degrees")


def psf_warnings(folder: Path, raw: Path, *psfs: Path) -> tuple[str, ...]:
    """Return the warnings of `diffuscope reconstruct`, without those about brightness."""
    made = reconstruct_file(raw, ReconstructOptions(psfs=psfs, plans=folder))
    return tuple(words for words in made.report.warnings if "too bright" not in words)


def test_the_folders_of_the_recordings_are_recognised() -> None:
    """Layout, pairs, and what reading applies to each."""
    dlmd = open_dataset(DATA / "dlmd")
    assert [entry.name for entry in dlmd.entries] == ["im43", "im65", "im326"]
    pair = next(iter(dlmd))
    assert pair.truth is not None
    stored = np.load(DATA / "dlmd/lensed/im43.npy")
    assert np.array_equal(pair.truth[60:270, 62:442], stored[::-1, :, ::-1][60:270, 62:442])
    assert np.isfinite(pair.truth).sum() == 210 * 380 * 3
    assert pair.psfs[0].name == "derived_psf_480x270_f32.npy"
    (hand,) = open_dataset(DATA / "tutorial")
    assert (hand.raw.shift, np.argwhere(hand.raw.bad).tolist()) == (4, [[0, 0], [0, 1]])
    (target,) = open_dataset(DATA / "diffusercam3d")
    assert [psf.name for psf in target.psfs] == [f"psf{depth:02}.tiff" for depth in range(0, 44, 4)]


def test_the_benchmark_of_dlmd_has_the_default_method_at_its_known_accuracy(tmp_path: Path) -> None:
    """Means over the channels; 300 rounds of FISTA (non-negative, no prior) correlate by 0.76, 0.88 and 0.84."""
    request = BenchmarkRequest(open_dataset(DATA / "dlmd"), None, ("open",), 1, None, tmp_path)
    found = benchmark(request, None, SystemClock(), lambda line: None)
    assert found.left_out == ()
    scores = {score.pair: score.pcc or 0.0 for score in found.scores}
    assert {name: pcc for name, pcc in scores.items() if pcc < {"im43": 0.80, "im65": 0.87, "im326": 0.90}[name]} == {}
