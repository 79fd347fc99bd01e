"""Replayed recordings through the whole instrument: real raw frames, no lamp, never marked as simulated."""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from device.clock import Clock, VirtualClock
from device.config.image_files import as_raw, read_image
from device.errors import CameraMissing, DiffuscopeError, PsfError, SpecError
from device.head import Head, open_head, recording_spec
from device.light_safety.dose_ledger import MemoryLedger
from device.values import ExposureSettings, Illumination
from services.imaging.picture_files import raw_tiff, read_raw_tiff
from services.imaging.raw_metadata import RawMetadata
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.resumption import MADE_AT_START, ResumedTarget
from services.instrument.watchdog import Watchdog
from services.records.capture import BUDGET_S, Capture
from services.records.capture_journal import ResumableCapture
from services.records.capture_store import CaptureStore
from services.records.capture_target import TEST_PICTURE, CaptureTarget
from tests import scenes
from tests.journey.asking import live_picture

SHAPE = (120, 160)
RECORDINGS = Path(__file__).parents[3] / "shared" / "data" / "lensless"
Played = Callable[..., tuple[Capture, ExamService]]


def spots(seed: int = 0) -> Any:
    """Return an object of bright squares on black."""
    scene = np.zeros(SHAPE)
    scene[40:80, 50:110] = np.kron(np.random.default_rng(seed).random((4, 6)), np.ones((10, 10)))
    return scene


def blurred(seed: int = 0) -> Any:
    """Return the 12-bit sensor frame of the object, blurred by the PSF, with noise."""
    rng = np.random.default_rng(seed)
    otf = np.fft.rfft2(np.fft.ifftshift(scenes.speckle(SHAPE)))
    seen = np.fft.irfft2(np.fft.rfft2(spots(seed)) * otf, SHAPE)
    return np.clip(64 + 3500 * seen / seen.max() + rng.normal(0, 2, SHAPE), 0, 4095)


def psf_counts() -> Any:
    psf = scenes.speckle(SHAPE)
    return np.rint(64 + 3900 * psf / psf.max()).astype(np.uint16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a recording that is described by its file names only."""
    folder = tmp_path / "recording"
    folder.mkdir()
    tifffile.imwrite(folder / "raw.tiff", np.rint(blurred()).astype(np.uint16))
    tifffile.imwrite(folder / "psf.tiff", psf_counts())
    return folder


@pytest.fixture
def play(tmp_path: Path, plans: Path) -> Iterator[Played]:
    """Return a function that replays a recording, takes one capture and returns it with the exam."""
    with ExitStack() as undo:

        def played(*where: Any) -> tuple[Capture, ExamService]:
            clock = VirtualClock()
            head = open_head(recording_spec(*where), clock, MemoryLedger(clock))
            assert head.kind == "recording"
            store = undo.enter_context(
                CaptureStore(tmp_path / f"store{len(list(tmp_path.iterdir()))}", reserve_bytes=0)
            )
            exam = begun(head, store, EventBus(), clock, plans)
            undo.callback(exam.close)
            return exam.press("OD").result(60), exam

        yield played


def begun(
    head: Head,
    store: CaptureStore,
    event_bus: EventBus,
    clock: Clock,
    plans: Path,
    target_of: ResumedTarget = lambda _: TEST_PICTURE,
) -> ExamService:
    return ExamService(head, store, event_bus, clock, plans, lambda: None, Watchdog(None), lambda: BUDGET_S, target_of)


def opened(folder: Path) -> Head:
    clock = VirtualClock()
    return open_head(recording_spec(folder), clock, MemoryLedger(clock))


def lit(head: Head) -> Any:
    with head.light.on(Illumination("green")):
        return head.camera.expose(ExposureSettings(0.02)).counts


def test_one_press_on_a_recording_gives_a_picture_that_is_not_marked(folder: Path, play: Played) -> None:
    kept, exam = play(folder)
    assert kept.simulated is False
    assert json.loads(exam.store.read(kept.id, "report.json"))["simulated"] is False
    raw, metadata = read_raw_tiff(exam.store.read(kept.id, "raw.tiff"))
    assert metadata.simulated is False
    assert np.array_equal(raw, read_image(folder / "raw.tiff"))
    with Image.open(BytesIO(exam.store.read(kept.id, "picture.png"))) as picture:
        assert picture.info["simulated"] == "false"
        assert picture.size == (160, 120)
        pixels = np.asarray(picture).astype(float)
    assert np.corrcoef(pixels.ravel(), spots().ravel())[0, 1] > 0.5


class EndsAtVerdict(EventBus):
    """Event bus that ends the process of an exam after the exposure, when its first verdict is published."""

    def publish(self, kind: str, **facts: Any) -> None:
        if kind == "verdict":
            raise ZeroDivisionError("unexpected")
        super().publish(kind, **facts)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # on purpose
def test_a_press_on_a_recording_that_is_resumed_with_its_one_frame_is_whole(
    folder: Path, plans: Path, tmp_path: Path
) -> None:
    key = "0" * 16
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:
        exam = begun(opened(folder), store, EndsAtVerdict(), VirtualClock(), plans)
        with pytest.raises(DiffuscopeError, match="unexpectedly"):
            exam.press("OD", key).result(60)
        exam.close()
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:

        def same_colours(interrupted: ResumableCapture) -> CaptureTarget:
            return CaptureTarget(colours=interrupted.colours)

        exam = begun(opened(folder), store, EventBus(), VirtualClock(), plans, same_colours)
        capture = exam.press("OD", key).result(60)
        exam.close()
    assert MADE_AT_START in capture.report.warnings
    assert {"raw.tiff", "dark.tiff"} <= set(capture.files)


def test_a_recording_of_a_simulated_raw_stays_simulated(folder: Path, play: Played) -> None:
    counts = read_image(folder / "raw.tiff")
    (folder / "raw.tiff").write_bytes(raw_tiff(counts, RawMetadata(simulated=True)))
    kept, exam = play(folder)
    assert kept.simulated is True
    with Image.open(BytesIO(exam.store.read(kept.id, "picture.png"))) as picture:
        assert picture.info["simulated"] == "true"


def test_a_preview_of_a_recording_comes_too(folder: Path, play: Played) -> None:
    _, exam = play(folder)
    live = live_picture(exam, 0, wait_s=20.0)  # a busy computer may exceed the default of two seconds
    assert live is not None
    with Image.open(BytesIO(live.jpeg)) as picture:
        assert b"simulated=false" in picture.info["comment"]


def test_several_raws_are_played_in_turn_and_a_thumbnail_psf_is_left_out(folder: Path) -> None:
    tifffile.imwrite(folder / "raw2.tiff", np.rint(blurred(1)).astype(np.uint16))
    tifffile.imwrite(folder / "psf_figure.tiff", psf_counts()[::4, ::4])
    head = opened(folder)
    first, second, again = lit(head), lit(head), lit(head)
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)
    assert len(head.calibration.psfs) == 1
    head.close()
    with pytest.raises(CameraMissing):
        head.camera.expose(ExposureSettings(0.02))


def test_the_right_psf_of_a_stack_is_found(folder: Path, play: Played) -> None:
    (folder / "psf.tiff").unlink()
    for index, seed in enumerate((3, 0, 5)):
        psf = scenes.speckle(SHAPE, seed)
        tifffile.imwrite(folder / f"psf{index}.tiff", psf)
    kept, _ = play(folder)
    assert kept.report.psf_index == 1


def test_a_float_recording_is_put_on_counts_by_one_scale(folder: Path, play: Played) -> None:
    (folder / "raw.tiff").unlink()
    original = ((blurred() - 64) / 4000).astype(np.float32)
    original[0, :5] = np.nan
    np.save(folder / "raw.npy", original)
    head = opened(folder)
    counts, dark = lit(head).astype(float), head.camera.expose(ExposureSettings(0.02)).counts.astype(float)
    ratio = (counts - dark)[1:] / np.where(np.abs(original[1:]) > 0.1, original[1:], np.nan)
    assert np.nanstd(ratio) < 1e-3 * np.nanmean(ratio)
    assert counts.max() == 60000
    assert head.calibration.bad is not None
    assert head.calibration.bad.sum() == 5
    kept, _ = play(folder)
    assert kept.report.stopped == "done"


def test_a_recording_in_three_channels_gives_a_picture_in_colour(folder: Path, play: Played) -> None:
    colour = np.stack([blurred() * share for share in (1.0, 0.5, 0.25)], axis=2)
    tifffile.imwrite(folder / "raw.tiff", np.rint(colour).astype(np.uint16), photometric="rgb")
    kept, exam = play(folder)
    with Image.open(BytesIO(exam.store.read(kept.id, "picture.png"))) as picture:
        pixels = np.asarray(picture).astype(float)
    assert pixels.shape == (120, 160, 3)
    spots = pixels[40:80, 50:110].mean(axis=(0, 1))
    assert spots[0] > spots[1] > spots[2]


TOML = """
name = "Bench recording"
[camera]
backend = "replay"
rows = 120
cols = 160
pitch_um = 20.0
full_well_e = 20000
read_noise_e = 2
[light]
backend = "replay"
[optics]
iris_um = 3200
diffuser_to_sensor_um = 6000
angular_magnification = 0.75
field_deg = 20
[replay]
raws = ["a/one.tiff"]
psfs = ["point.tiff"]
black_dn = 64
"""


@pytest.fixture
def described(folder: Path) -> Path:
    """Return a recording that is described by a recording.toml."""
    (folder / "a").mkdir()
    (folder / "raw.tiff").rename(folder / "a" / "one.tiff")
    (folder / "psf.tiff").rename(folder / "point.tiff")
    (folder / "recording.toml").write_text(TOML)
    return folder


def test_a_recording_toml_names_the_files_the_geometry_and_the_black_level(described: Path, play: Played) -> None:
    kept, exam = play(described)
    head = exam.head
    assert head.spec.name == "Bench recording"
    assert head.calibration.geometry is not None
    assert head.calibration.field_deg == 20
    assert (head.camera.expose(ExposureSettings(0.02)).counts == 64).all()
    radius_px = 10 * head.calibration.geometry.px_per_deg
    with Image.open(BytesIO(exam.store.read(kept.id, "picture.png"))) as picture:
        assert picture.size[0] == pytest.approx(2 * radius_px, abs=10)


def test_the_dark_frame_of_a_left_justified_recording_moves_with_it(described: Path) -> None:
    (described / "recording.toml").write_text(TOML + 'dark = "dark.tiff"\n')
    dark = np.random.default_rng(0).integers(60, 68, SHAPE).astype(np.uint16)
    raw = read_image(described / "a" / "one.tiff")
    for path, counts in ((described / "dark.tiff", dark), (described / "a" / "one.tiff", raw)):
        tifffile.imwrite(path, counts << np.uint16(4))
    head = opened(described)
    assert np.array_equal(lit(head), raw)
    assert np.array_equal(head.camera.expose(ExposureSettings(0.02)).counts, dark)


def test_the_dark_frame_of_a_float_recording_is_scaled_with_it(described: Path) -> None:
    (described / "a" / "one.tiff").unlink()
    text = TOML.replace("one.tiff", "one.npy").replace("black_dn = 64", 'dark = "dark.npy"')
    (described / "recording.toml").write_text(text)
    np.save(described / "a" / "one.npy", blurred().astype(np.float32) / 4095)
    np.save(described / "dark.npy", np.full(SHAPE, 64 / 4095, np.float32))
    head = opened(described)
    counts, dark = lit(head).astype(float), head.camera.expose(ExposureSettings(0.02)).counts.astype(float)
    original = read_image(described / "a" / "one.npy") * 4095
    scale = (60000 - 1000) / original.max()
    assert np.allclose(counts - dark, (original - 64) * scale, atol=1.5)


def refused(*where: Any) -> SpecError | PsfError:
    with pytest.raises((SpecError, PsfError)) as error:
        open_head(recording_spec(*where), VirtualClock(), MemoryLedger(VirtualClock()))
    assert error.value.remedy
    return error.value


def test_an_ambiguous_folder_is_refused_with_a_remedy(folder: Path) -> None:
    (folder / "raw.tiff").rename(folder / "one.tiff")
    tifffile.imwrite(folder / "two.tiff", np.rint(blurred(1)).astype(np.uint16))
    error = refused(folder)
    assert "0 files that are raws and 1 that are PSFs" in error.message
    assert "recording.toml" in error.remedy
    (folder / "two.tiff").unlink()
    assert opened(folder).camera.shape == SHAPE  # a single image that is no PSF is the raw frame


def test_an_invalid_recording_is_refused(folder: Path, described: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "0 files that are raws and 0" in refused(empty).message
    assert "is not a folder" in refused(tmp_path / "nowhere").message
    (described / "recording.toml").write_text(TOML[: TOML.index("[replay]")])
    assert "[replay]" in refused(described).message
    (described / "recording.toml").write_text(TOML.replace("psfs", "psf"))
    assert "did you mean 'psfs'?" in refused(described).message
    raw = folder / "a" / "one.tiff"
    assert "both" in refused(folder, (raw,), ()).message


def test_files_that_do_not_belong_together_are_refused(folder: Path, described: Path) -> None:
    raw, psf, small = folder / "a" / "one.tiff", folder / "point.tiff", folder / "small.tiff"
    tifffile.imwrite(small, psf_counts()[:60, :80])
    assert "small.tiff has 60 x 80 pixels, the raw 120 x 160" in refused(folder, (raw,), (small,)).message
    assert "same rows and columns" in refused(folder, (raw, small), (psf,)).message
    (described / "recording.toml").write_text(TOML + 'dark = "small.tiff"\n')
    assert "small.tiff" in refused(described).message


def test_named_files_need_no_folder_of_their_own(folder: Path, play: Played) -> None:
    raw, psf = folder / "raw.tiff", folder / "psf.tiff"
    kept, _ = play(folder, (raw,), (psf,))
    assert kept.simulated is False
    assert recording_spec(Path(), (raw,), (psf,)).name  # a name, also for files in the current folder


@pytest.mark.data
@pytest.mark.skipif(not RECORDINGS.is_dir(), reason=f"the recordings are not in {RECORDINGS}")
@pytest.mark.parametrize(
    ("name", "shape", "psf"),
    [
        ("tutorial", (1200, 1600), "psf_sample.tif"),
        ("diffusercam3d", (270, 320), "psf16.tiff"),
        ("dlmd", (270, 480, 3), "derived_psf_480x270_f32.npy"),
    ],
)
def test_a_real_recording_gives_a_picture_after_one_press(
    play: Played, name: str, shape: tuple[int, ...], psf: str
) -> None:
    kept, exam = play(RECORDINGS / name)
    assert kept.simulated is False
    assert exam.head.calibration.psfs[kept.report.psf_index].name == psf
    with Image.open(BytesIO(exam.store.read(kept.id, "picture.png"))) as picture:
        pixels = np.asarray(picture).astype(float)
    assert pixels.shape == shape
    assert pixels.std() > 10  # neither black nor uniform
    if name == "tutorial":
        assert pixels[440:720, 780:1020].mean() > pixels.mean() + pixels.std()  # the hand in the scene
        assert as_raw(read_image(RECORDINGS / name / "rawdata_hand_sample.tif")).shift == 4
