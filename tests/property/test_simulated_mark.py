"""The mark of simulated pictures: every command and endpoint that writes a picture keeps what its inputs state.

`WRITERS` names each place that encodes a picture with the test that sends marked and unmarked inputs through it; a new
place fails until it is listed. The mutants of `tests/golden/mutants.py` drop the mark at one place each.
"""

import ast
import io
import json
import re
import zipfile
from base64 import b64decode
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from secrets import token_hex
from typing import Any

import diffuscope
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow

from device.calibration.archive import Archive
from device.calibration.procedure.raw_recorder import RawRecorder
from device.clock import VirtualClock
from device.config.head_file import load_head
from device.config.marked_files import marked_pixels, stated_in, stated_mark, tiff_bytes, write_npy
from device.light_safety.dose_report import DoseReport
from device.ports import Camera
from device.recon.stage import Recipe
from device.sim.scene_files import simulate_exposure
from device.values import Counts, ExposureSettings, Frame, Illumination, SimulatedCounts, Verdict
from services.archive.plan import read_plan
from services.archive.result import ResultFolder
from services.archive.solve import CalibrationFiles, Solvers, Task, local_names
from services.imaging.picture_files import raw_tiff, to_png
from services.imaging.raw_metadata import RawMetadata
from services.instrument.accuracy_explorer import SHIPPED, AccuracyExplorer, StoredCapture
from services.instrument.camera_tap import CameraTap
from services.instrument.capture import ExposedCapture, Press, capture_files
from services.instrument.events import EventBus
from services.instrument.exam_events import ExamEvents
from services.instrument.exam_requests import ExamRequests
from services.instrument.press_exposure import Exposure
from services.instrument.progress import Progress
from services.instrument.visit_montage import join_pictures
from services.instrument.watchdog import Watchdog
from services.records.capture import Capture, CaptureReport, RecordOrigin
from services.records.capture_store import CaptureStore
from services.records.capture_target import CaptureTarget
from services.research.frontier import measure_scene
from services.research.frontier_thumbnails import Shown, thumbnail_panel
from tests.journey.asking import next_preview, visit_with_consent
from tests.journey.conftest import Rig, coarsened, rig_builder
from tests.journey.wrong_inputs import call
from tests.moving_retina import PSF, RETINA, SHAPE, WIDE_RETINA, frame, gaze, seen
from tests.paper.pictures import plane, side_by_side
from tests.parsed_commands import parsed_commands
from tests.simulated import small_head_toml
from tests.stored_captures import write_store
from tests.unit.test_archive_adopt import FILE, HERE, NAMES, RAW, adopted, planned, write_results

ROOT = Path(__file__).parents[2]
LINEAR, SHOWN = (".npy", ".tiff"), (".png", ".jpg", ".jpeg")
EMBEDDED = re.compile(r"data:image/(png|jpeg);base64,([A-Za-z0-9+/=]+)")

both = pytest.mark.parametrize("simulated", [True, False], ids=("marked", "unmarked"))


def check(path: Path, simulated: bool) -> None:
    """Assert that a file states what it is, also in the pixels of a picture for eyes."""
    assert stated_mark(path) is simulated, path.name
    if path.suffix in SHOWN:
        check_pixels(path.name, path.read_bytes(), simulated)


def check_pixels(name: str, content: bytes, simulated: bool) -> None:
    """Assert that a PNG or JPEG states what it is, and has the band of letters if it is simulated, else not."""
    assert stated_in(name, io.BytesIO(content)) is simulated, name
    with Pillow.open(io.BytesIO(content)) as image:
        pixels = np.asarray(image)
    away = np.abs(pixels.astype(int) - marked_pixels(pixels, True)).max()
    assert bool(away < 90) is simulated, name  # JPEG blurs the letters by less; an unmarked corner differs by 255


# ---- Commands


@pytest.fixture
def inputs(tmp_path: Path, simulated: bool) -> Path:
    """A folder with two raw frames and a PSF that state whether they are simulated."""
    for number, name in enumerate(("green", "red")):
        counts = frame(seen(RETINA, (2.0 * number, -3.0 * number)), 8000, number)
        (tmp_path / f"{name}.tiff").write_bytes(tiff_bytes(counts, simulated))
    (tmp_path / "psf.tiff").write_bytes(tiff_bytes(psf_counts(), simulated))
    return tmp_path


@cache
def psf_counts() -> Counts:
    centred = np.zeros(SHAPE, np.float32)
    centred[140:221, 200:281] = PSF.pixels
    return np.asarray(centred / centred.max() * 60000, np.uint16)


def run(*words: object) -> str:
    done = call([str(word) for word in words])
    assert done.code == 0, done.err
    return done.err


def reconstruct(inputs: Path, out: str, *words: object) -> None:
    run("reconstruct", *words, "-o", inputs / out, "--report", inputs / "report.json")


@both
@pytest.mark.parametrize("ending", [".png", *LINEAR])
def test_reconstruct(inputs: Path, simulated: bool, ending: str) -> None:
    psf = ("--psf", inputs / "psf.tiff", "--method", "tikhonov")
    reconstruct(inputs, f"out{ending}", inputs / "green.tiff", *psf)
    check(inputs / f"out{ending}", simulated)
    check(inputs / "report.json", simulated)


@both
def test_reconstruct_each(inputs: Path, simulated: bool) -> None:
    psf = ("--psf", inputs / "psf.tiff", "--method", "tikhonov")
    run("reconstruct", "--each", inputs / "green.tiff", *psf, "-o", inputs / "all", "--report", inputs / "reports")
    check(inputs / "all" / "green.tiff", simulated)
    check(inputs / "reports" / "green.json", simulated)


@both
def test_reconstruct_burst(inputs: Path, simulated: bool) -> None:
    """One marked frame marks the picture."""
    (inputs / "third.tiff").write_bytes(tiff_bytes(frame(seen(RETINA, (0, 0)), 8000, 9), False))
    raws = [inputs / f"{name}.tiff" for name in ("third", "red", "green")]
    reconstruct(inputs, "out.png", *raws, "--psf", inputs / "psf.tiff", "--method", "tikhonov")
    check(inputs / "out.png", simulated)
    check(inputs / "report.json", simulated)


@both
def test_reconstruct_channels(inputs: Path, simulated: bool) -> None:
    psf = inputs / "psf.tiff"
    channels = [word for name in ("green", "red") for word in ("--channel", name, inputs / f"{name}.tiff", psf)]
    reconstruct(inputs, "out.png", *channels, "--method", "tikhonov")
    check(inputs / "out.png", simulated)
    check(inputs / "report.json", simulated)


@both
@pytest.mark.parametrize("ending", [".png", *LINEAR])
def test_montage(tmp_path: Path, simulated: bool, ending: str) -> None:
    """Montages of marked PNG, TIFF and npy files are marked; a second, unmarked picture changes nothing."""
    first, out = tmp_path / f"first{ending}", tmp_path / "out.png"
    if ending == ".png":
        first.write_bytes(to_png(gaze(WIDE_RETINA, (0, 0)), simulated))
    elif ending == ".tiff":
        first.write_bytes(tiff_bytes(gaze(WIDE_RETINA, (0, 0)), simulated))
    else:
        write_npy(first, gaze(WIDE_RETINA, (0, 0)), simulated)
    (tmp_path / "second.tiff").write_bytes(tiff_bytes(gaze(WIDE_RETINA, (30, 10), 0, 1), False))
    notes = run("montage", first, tmp_path / "second.tiff", "-o", out, "--report", tmp_path / "report.json")
    assert "side file" not in notes
    check(out, simulated)
    check(tmp_path / "report.json", simulated)
    run("montage", first, "-o", tmp_path / f"alone{ending}")
    check(tmp_path / f"alone{ending}", simulated)


def test_an_npy_without_a_side_file_counts_as_not_simulated_with_a_note(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", gaze(WIDE_RETINA, (0, 0)))
    notes = run("montage", tmp_path / "a.npy", "-o", tmp_path / "out.npy")
    assert "a.npy has no side file a.npy.json" in notes
    check(tmp_path / "out.npy", False)


@pytest.fixture
def head(tmp_path: Path) -> Path:
    path = tmp_path / "head.toml"
    path.write_text(small_head_toml("Small simulated head", summed=4))
    return path


def test_simulate_and_frame(head: Path, tmp_path: Path) -> None:
    run("simulate", head, "-o", tmp_path / "scene")
    for name in ("raw.tiff", "psf.tiff", "truth.npy"):
        check(tmp_path / "scene" / name, True)
    vessels = tmp_path / "scene" / "vessels.png"
    assert stated_mark(vessels) is True
    with Pillow.open(vessels) as image:
        assert set(np.unique(np.asarray(image))) <= {0, 255}, "a mask, without letters"
    run("frame", "--head", head, "-o", tmp_path / "frame.tiff")
    check(tmp_path / "frame.tiff", True)


@both
def test_calibrations(inputs: Path, simulated: bool) -> None:
    """An imported PSF keeps its mark in the archive, in its arrays and in a signed file."""
    archive = ("--archive", inputs / "archive")
    known = ("--black-dn", "64", "--white-dn", "65535", "--by", "Ada", "--source", "a pinhole")
    run("calibrations", "import-psf", inputs / "psf.tiff", *known, *archive)
    stored = Archive(inputs / "archive")
    (id,) = stored.ids()
    assert stored.load(id).calibration.simulated is simulated
    assert stated_mark(inputs / "archive" / id / "psf0.npy") is simulated
    run("calibrations", "new-key", inputs / "key", "--name", "Service centre")
    run("calibrations", "export", id, inputs / "signed", *archive, "--key", inputs / "key")
    packed = (inputs / "signed").read_bytes()
    assert stated_in("signed.zip", io.BytesIO(packed[packed.index(b"PK\x03\x04") :])) is simulated


@both
def test_raw_frames_of_a_calibration(tmp_path: Path, simulated: bool) -> None:
    recorder = RawRecorder(tmp_path, lambda _: None, 0)
    recorder.begin_step("darks")
    recorder.record(Frame(np.zeros((8, 9), np.uint16), 0.1, 1, None, simulated))
    check(tmp_path / "darks" / "00001_0.1s.npy", simulated)


@both
@pytest.mark.parametrize("ending", [".png", *LINEAR])
def test_python(tmp_path: Path, simulated: bool, ending: str) -> None:
    counts = frame(seen(RETINA, (0, 0)), 8000, 0)
    made = diffuscope.reconstruct(
        counts.view(SimulatedCounts) if simulated else counts, psf_counts(), method="tikhonov"
    )
    made.save(tmp_path / f"out{ending}")
    check(tmp_path / f"out{ending}", simulated)


@both
def test_pictures_of_an_archive(inputs: Path, simulated: bool) -> None:
    for name in ("raw", "truth"):
        (inputs / "recording" / name).mkdir(parents=True)
    (inputs / "green.tiff").rename(inputs / "recording" / "raw" / "eye.tiff")
    (inputs / "psf.tiff").rename(inputs / "recording" / "psf.tiff")
    np.save(inputs / "recording" / "truth" / "eye.npy", seen(RETINA, (0, 0)))
    run("archive", "plan", inputs / "recording", "-o", inputs / "plan.toml", "--method", "tikhonov")
    plan, results = read_plan(inputs / "plan.toml"), ResultFolder(inputs / "out")
    results.prepare(plan)
    (calibration,), (capture,) = plan.calibrations, plan.captures
    files = CalibrationFiles(inputs / "calibrations")
    named = zip(local_names(calibration), calibration.files, strict=True)
    files.add(calibration.digest, {name: Path(file.path).read_bytes() for (_, name), file in named})
    done = Solvers(files).solve(Task(capture, calibration, plan.settings, plan.software), results, "worker")
    assert done.failure is None, done.failure
    check(results.place(capture.result) / "picture.tiff", simulated)
    check(results.place(capture.result) / "report.json", simulated)


@both
def test_adopted_pictures(tmp_path: Path, simulated: bool) -> None:
    """A new version of a stored capture, green and in colour."""
    write_store(tmp_path / "store", RAW, "0123456789abcdef", NAMES, RecordOrigin(uuid=HERE))
    (tmp_path / "store" / FILE).write_text(json.dumps({"uuid": HERE, "serial": "1"}))
    out = write_results(tmp_path / "out", [planned(tmp_path / "store", "one")], simulated=simulated)
    assert adopted(out, tmp_path / "store").adopted == 1
    with CaptureStore(tmp_path / "store") as store:
        for name in ("picture-1.png", "colour-1.png"):
            assert stated_in(name, io.BytesIO(store.read("one", name))) is simulated, name


@both
def test_thumbnails_of_a_frontier(simulated: bool) -> None:
    truth = np.random.default_rng(0).uniform(0, 1, (300, 400)).astype(np.float32)
    panel = thumbnail_panel([Shown(("a",), truth)], truth, np.ones(truth.shape, np.bool_), simulated)
    check_embedded("".join(panel.elements), simulated, 2)


def test_pictures_of_the_paper() -> None:
    picture, inside = np.random.default_rng(0).uniform(0, 1, (60, 70)).astype(np.float32), np.ones((60, 70), np.bool_)
    drawn = plane("", picture).address + side_by_side("", "x.png", [(picture, inside)] * 2).address
    check_embedded(drawn.replace("data:", " data:"), True, 2)


def check_embedded(text: str, simulated: bool, count: int) -> None:
    """Assert the mark of each picture in a page or drawing."""
    found = EMBEDDED.findall(text)
    assert len(found) == count
    for kind, content in found:
        check_pixels(f"x.{kind}", b64decode(content), simulated)


def test_pictures_of_the_documents() -> None:
    for name in ("human-eye.png", "heads-eye.png", "elements-eye.png"):
        check(ROOT / "hardware/pictures" / name, True)
    for path in (SHIPPED / "frontier.svg", ROOT / "hardware/pictures/frontier-eye.svg"):
        drawing = path.read_text()
        # The truth and one picture for each different choice of the time budgets.
        assert drawing.count("<image") > 1
        check_embedded(drawing, True, drawing.count("<image"))


# ---- Endpoints


@dataclass
class UnmarkedCamera:
    """A camera whose frames are not marked as simulated, as those of a real one."""

    inner: Camera

    @property
    def shape(self) -> tuple[int, int]:
        return self.inner.shape

    @property
    def facts(self) -> Any:
        return self.inner.facts

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        return replace(self.inner.expose(shot, into), simulated=False)

    def prepare(self, shot: ExposureSettings) -> None:
        self.inner.prepare(shot)

    def close(self) -> None:
        self.inner.close()


@pytest.fixture(scope="module", params=[True, False], ids=("marked", "unmarked"))
def taken(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Any, bool]]:
    """An instrument with a camera that marks its frames or not, a visit with one picture, and whether it is marked."""
    folder, simulated = tmp_path_factory.mktemp("rig"), bool(request.param)
    (folder / "head.toml").write_text(small_head_toml("Small simulated head"))
    build = rig_builder(coarsened(load_head(folder / "head.toml")), tmp_path_factory.mktemp("plans"))
    with ExitStack() as undo:
        rig = build(folder, undo, camera=(lambda camera: camera) if simulated else UnmarkedCamera)
        visit = visit_with_consent(rig)
        press = {"key": token_hex(8), "eye": "OD", "visit": visit["id"], "slot": "R-centre"}
        answer = rig.request("POST", "/api/captures", json=press)
        assert answer.status_code == 201, answer.text
        yield rig, answer.json(), simulated


def test_files_of_a_capture(taken: tuple[Rig, Any, bool]) -> None:
    rig, capture, simulated = taken
    files = rig.store.get(capture["id"]).files
    assert {"picture.png", "colour.png", "quick.jpg", "raw.tiff", "raw-red.tiff", "dark.tiff", "report.json"} <= set(
        files
    )
    for name in files:
        content = rig.request("GET", f"/api/captures/{capture['id']}/{name}").content
        assert stated_in(name, io.BytesIO(content)) is simulated, name
        if Path(name).suffix in SHOWN:
            check_pixels(name, content, simulated)


@both
def test_encoded_files_of_a_capture(simulated: bool) -> None:
    """All files are encoded when it is stored."""
    at, picture = VirtualClock().wall(), np.random.default_rng(0).uniform(0, 1, (90, 120)).astype(np.float32)
    exposed = Frame(np.full((90, 120), 500, np.uint16), 0.1, 1, Illumination("green"), simulated)
    press = Press(Future(), "OD", CaptureTarget(), None)
    shot = ExposedCapture(
        press, "a", at, Exposure((exposed,), {}, None, 0.0, 0.2, 0.0), DoseReport(), Verdict("good", None, {})
    )
    capture = Capture("a", "OD", at, simulated, "c", CaptureReport("tikhonov"), {})
    files = capture_files(capture, "head", shot, picture, np.stack([picture] * 3, axis=2))
    for name, content in files.items():
        assert isinstance(content, bytes)
        assert stated_in(name, io.BytesIO(content)) is simulated, name


@both
def test_quick_look_in_progress(simulated: bool) -> None:
    """The page shows it before the files of the capture are stored."""
    clock = VirtualClock()
    events = ExamEvents(EventBus(), Watchdog(None), Progress(clock, 0.1, lambda: 0.26), ExamRequests(clock))
    picture = np.random.default_rng(0).uniform(0, 1, (90, 120)).astype(np.float32)
    events.quick_look(Press(Future(), "OD", CaptureTarget(), None), "a", picture, simulated)
    check_pixels("quick.jpg", events.output.quick_looks["a"], simulated)


def test_quick_look_and_live_picture(taken: tuple[Rig, Any, bool]) -> None:
    rig, capture, simulated = taken
    assert capture["simulated"] is simulated
    number = next_preview(rig, 0)
    live = rig.request("GET", f"/api/preview?after={number - 1}&eye=OD")
    assert live.status_code == 200
    check_pixels("live.jpg", live.content, simulated)


def test_export(taken: tuple[Rig, Any, bool]) -> None:
    rig, capture, simulated = taken
    archive = rig.request("GET", f"/api/visits/{capture['visit']}/export.zip").content
    assert stated_in("export.zip", io.BytesIO(archive)) is simulated
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        pictures = [name for name in files.namelist() if name.endswith(".png")]
        assert len(pictures) == 2, "green and colour"
        for name in pictures:
            check_pixels(name, files.read(name), simulated)


def test_export_after_a_correction_of_the_eye(taken: tuple[Rig, Any, bool]) -> None:
    rig, capture, simulated = taken
    moved = {"key": token_hex(8), "eye": "OS"}
    assert rig.request("POST", f"/api/captures/{capture['id']}/eye", json=moved).status_code == 200
    archive = rig.request("GET", f"/api/visits/{capture['visit']}/export.zip").content
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        pictures = [name for name in files.namelist() if name.endswith(".png")]
        assert all(Path(name).name.startswith("L-") for name in pictures)
        for name in pictures:
            check_pixels(name, files.read(name), simulated)


@both
def test_montage_of_a_visit(simulated: bool) -> None:
    pictures = [to_png(gaze(WIDE_RETINA, shift, 0, k), simulated) for k, shift in enumerate([(0, 0), (30, 10)])]
    joined = join_pictures(pictures, simulated, None, lambda _: None)
    assert joined.png is not None
    check_pixels("montage.png", joined.png, simulated)


@both
def test_picture_of_another_method(head: Path, tmp_path: Path, simulated: bool) -> None:
    spec = load_head(head)
    scene = simulate_exposure(spec)
    explorer = AccuracyExplorer(
        tmp_path / "accuracy", tmp_path / "plans", VirtualClock(), spec, lambda kind, **_: None, measure_scene
    )
    raw, dark = (raw_tiff(counts, RawMetadata()) for counts in (scene.counts, np.full_like(scene.counts, 64)))
    again = explorer.reconstruct(StoredCapture(raw, dark, scene.calibration, simulated), Recipe("tikhonov", 1))
    check_pixels("again.png", again, simulated)


class EvenCamera:
    """A camera of grey frames, marked or not."""

    shape, facts = (240, 320), {}

    def __init__(self, simulated: bool) -> None:
        self.simulated = simulated

    def expose(self, shot: ExposureSettings, into: NDArray[np.uint16] | None = None) -> Frame:
        return Frame(np.full(self.shape, 2000, np.uint16), shot.exposure_s, 1, None, self.simulated)

    def prepare(self, shot: ExposureSettings) -> None:
        pass

    def close(self) -> None:
        pass


@both
def test_live_picture_of_a_calibration(head: Path, simulated: bool) -> None:
    tap = CameraTap(EvenCamera(simulated), load_head(head).camera, VirtualClock(), lambda: None)
    assert tap.next_picture(0, 0.0) is None  # requests pictures
    tap.expose(ExposureSettings(0.1))
    shown = tap.next_picture(0, 0.0)
    assert shown is not None
    check_pixels("live.jpg", shown.jpeg, simulated)


# ---- The list

CAPTURE, EACH = "test_files_of_a_capture", "test_reconstruct_each"
IN_REPORT = "tests/archive/test_archive_report.py::test_pictures_are_marked_where_their_frames_are_simulated"
WRITERS = {
    "device/calibration/procedure/raw_recorder.py record": "test_raw_frames_of_a_calibration",
    "device/config/marked_files.py write_linear": "test_reconstruct",
    "device/config/marked_files.py write_npy": "test_reconstruct",
    "device/sim/scene_files.py _write_vessels": "test_simulate_and_frame",
    "device/sim/scene_files.py write": "test_simulate_and_frame",
    "services/delivery/research_export.py _anonymised": "tests/journey/test_visit_export.py::"
    "test_a_research_export_names_no_patient_and_keeps_the_mark_of_a_simulation",
    "services/delivery/visit_export.py _picture": "test_export_after_a_correction_of_the_eye",
    "services/imaging/picture_files.py counts_jpeg": "test_live_picture_of_a_calibration",
    "services/imaging/picture_files.py raw_tiff": CAPTURE,
    "services/imaging/picture_files.py to_jpeg": CAPTURE,
    "services/imaging/picture_files.py to_png": CAPTURE,
    "services/imaging/picture_files.py with_note": "test_export_after_a_correction_of_the_eye",
    "services/instrument/accuracy_explorer.py _reconstruct": "test_picture_of_another_method",
    "services/instrument/camera_tap.py _publish": "test_live_picture_of_a_calibration",
    "services/instrument/capture.py capture_files": "test_encoded_files_of_a_capture",
    "services/instrument/capture.py content": "test_encoded_files_of_a_capture",
    "services/instrument/capture_pipeline.py live_picture": "test_quick_look_and_live_picture",
    "services/instrument/exam_events.py quick_look": CAPTURE,
    "services/instrument/visit_montage.py join_pictures": "test_montage_of_a_visit",
    "services/archive/adopt.py _adopt": "test_adopted_pictures",
    "services/archive/report.py _thumbnail": IN_REPORT,
    "services/archive/solve.py solve": "test_pictures_of_an_archive",
    "services/research/frontier_thumbnails.py _png": "test_thumbnails_of_a_frontier",
    "services/research/montage_files.py montage_files": "test_montage",
    "tests/paper/pictures.py _png": "test_pictures_of_the_paper",
    "services/research/reconstruct_burst.py reconstruct_burst": "test_reconstruct_burst",
    "services/research/reconstruct_burst.py reconstruct_colours": "test_reconstruct_channels",
    "services/research/reconstruct_each.py _reconstruct_one": EACH,
    "services/research/reconstruct_file.py reconstruct_file": "test_reconstruct",
    "services/research/reconstruct_file.py save": "test_python",
    "services/research/reconstruct_file.py write_picture": "test_reconstruct",
    "services/workshop/take_frames.py take_frames": "test_simulate_and_frame",
    "services/records/frame_writer.py _write": CAPTURE,
}
ENCODERS = {
    "png_bytes",
    "jpeg_bytes",
    "tiff_bytes",
    "write_npy",
    "write_side_file",
    "write_linear",
    "to_png",
    "to_jpeg",
    "counts_jpeg",
    "raw_tiff",
    "write_picture",
    "with_note",
}
FOREIGN = {"imwrite", "imsave", "savefig", "fromarray", "savez", "savez_compressed", "ZipFile"}  # and np.save
NO_PICTURES = {
    "device/calibration/archive.py _npy": "manifest.toml states the mark",
    "device/calibration/procedure/finished_steps.py save": "a checkpoint, with the mark in it",
    "device/calibration/procedure/raw_recorder.py record": "with a side file",
    "device/calibration/signing.py _unzip": "reads",
    "device/calibration/signing.py _zip_archive": "copies files that state the mark",
    "device/config/image_files.py _decode_npz": "reads",
    "device/sim/photo.py _eight_bits": "resamples",
    "hardware/parts/lens_plate.py export_plate": "height map of a part",
    "services/delivery/visit_export.py zip_archive": "copies files that state the mark",
    "services/imaging/picture_files.py to_jpeg": "resamples",
    "services/research/dataset_pairs.py _placed": "resamples",
    "tests/hard/cells.py files": "inputs of a command, deleted after it",
    "tests/hard/defects.py jpeg": "blocks of a JPEG, decoded at once",
    "services/research/lensless_peer.py solve": "answer of a process of another solver",
    "tests/paper/pictures.py side_by_side": "resamples",
    "services/research/peers.py __call__": "input of a process of another solver",
}


def calls(wanted: Callable[[ast.Call, str], bool]) -> set[str]:
    """Return file and function of each call, in product and experiments, for which `wanted` holds."""
    found = set()

    def walk(node: ast.AST, place: str, function: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Call):
                name = child.func.attr if isinstance(child.func, ast.Attribute) else getattr(child.func, "id", "")
                if wanted(child, name):
                    found.add(f"{place} {function}")
            walk(child, place, child.name if isinstance(child, ast.FunctionDef) else function)

    for root in ("device", "services", "hardware", "tests/paper", "tests/hard"):
        for path in (ROOT / root).rglob("*.py"):
            if "gallery" not in path.parts and not path.name.startswith("test_"):
                walk(ast.parse(path.read_text(encoding="utf-8")), str(path.relative_to(ROOT)), "module")
    return found


def test_every_place_that_encodes_a_picture_is_listed() -> None:
    assert calls(lambda _, name: name in ENCODERS) == set(WRITERS)
    for test in set(WRITERS.values()):
        file, _, name = test.rpartition("::")
        assert f"def {name}(" in (ROOT / file if file else Path(__file__)).read_text(encoding="utf-8"), test


def test_pictures_are_encoded_by_the_module_of_the_mark_only() -> None:
    def is_foreign(call: ast.Call, name: str) -> bool:
        is_np_save = name == "save" and isinstance(call.func, ast.Attribute) and ast.unparse(call.func.value) == "np"
        return name in FOREIGN or is_np_save

    found = {place for place in calls(is_foreign) if not place.startswith("device/config/marked_files.py ")}
    assert found == set(NO_PICTURES)


COMMANDS = {  # commands that write pictures; the others print, draw plots, or move files that are written already
    "reconstruct",
    "montage",
    "frame",
    "calibrate",
    "simulate",
    "frontier",
    "data",
    "bench",
    "paper",
    "hard",
    "calibrations export",
    "calibrations import",
    "calibrations import-psf",
    "archive run",
    "archive report",
    "archive adopt",
    "run",
}
OTHER_COMMANDS = {
    "label",
    "audit archive",
    "audit verify",
    "erase patient",
    "erase verify",
    "programme check",
    "users add",
    "users list",
    "users reset",
    "health",
    "doctor",
    "meter",
    "light",
    "trial-lenses",
    "white-card",
    "check",
    "chart",
    "optics",
    "methods",
    "calibrations list",
    "calibrations show",
    "calibrations use",
    "calibrations new-key",
    "update check",
    "update install",
    "update restart",
    "update settle",
    "update answer",
    "update tidy",
    "update status",
    "snapshots list",
    "snapshots restore",
    "store check",
    "store rebuild",
    "store copy",
    "store research",
    "store backup",
    "store restore",
    "archive plan",
}
ENDPOINTS = {
    "/api/calibration/preview",
    "/api/captures/{id}/{name}",
    "/api/preview",
    "/api/technician/accuracy.svg",  # of a simulated eye on any head: test_pictures_of_the_documents
    "/api/technician/captures/{id}/again.png",
    "/api/visits/{id}/export.zip",
    "/api/visits/{id}/montage/{eye}/picture.png",
}


def test_every_command_and_every_endpoint_is_listed() -> None:
    assert set(parsed_commands()) == COMMANDS | OTHER_COMMANDS
    record = json.loads((ROOT / "tests/golden/records/openapi.json").read_text())
    paths = record.get("paths") or record["openapi"]["paths"]
    kinds = ("image/", "application/zip")
    found = {
        path
        for path, methods in paths.items()
        for operation in methods.values()
        for answer in operation.get("responses", {}).values()
        if any(kind.startswith(kinds) for kind in answer.get("content", {}))
    }
    assert found == ENDPOINTS
