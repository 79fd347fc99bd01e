"""A press that ends with the process: its frames become a shorter burst under the same id and key at the next start."""

import signal
import subprocess
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from device.errors import DiffuscopeError, StoreFull
from device.ports import Camera
from device.values import ExposureSettings, Frame, Illumination
from services.errors import Busy, ConsentDeclined
from services.identity.audit_key import find_audit_key
from services.instrument.capture_pipeline import INTERRUPTED
from services.instrument.events import EventBus
from services.instrument.exam_loop import POSTPONED, UNTIL_BACK
from services.instrument.resumption import CALIBRATION_DARK, MADE_AT_START, NO_DARK, SHORTER
from services.records import blobs, digested_json
from services.records.capture_journal import MAX_ATTEMPTS
from services.records.capture_target import CaptureTarget
from services.records.patient_keys import PatientKeys
from services.records.patient_rows import patient_of_visit
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository
from tests.journey.conftest import Rig, until
from tests.journey.test_cli_server import Server
from tests.simulated import small_head_toml

KEY = "c" * 16
PICTURES = (b"\x89PNG", b"II*\0", b"MM\0*", b"\xff\xd8\xff")  # first bytes of PNG, TIFF and JPEG


class EndsAt:
    """Camera that raises an exception the exam does not know, which ends its process, in the exposure number `last`."""

    def __init__(self, camera: Camera, last: int) -> None:
        self._camera, self._left, self.shape = camera, last, camera.shape

    def prepare(self, shot: ExposureSettings) -> None:
        self._camera.prepare(shot)

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        self._left -= 1
        if self._left <= 0:
            raise ZeroDivisionError("unexpected")
        return self._camera.expose(shot, into)

    def close(self) -> None:
        self._camera.close()


def written(store: Path) -> dict[str, bytes]:
    """Return the frames of the press in progress that count, without their encryption: those with a whole note."""
    keys = PatientKeys(store, find_audit_key(store), readonly=True)
    notes = sorted(store.glob("journal/*/*.tiff.json"))
    return {note.stem: blobs.read_file(note.with_name(note.stem), keys) for note in notes if is_whole(note)}


def refuse_plain(store: Path, contents: Iterable[bytes]) -> None:
    """Assert that no file of a data folder holds the first kilobyte of a content, or begins as a picture."""
    files = {str(path): path.read_bytes() for path in store.rglob("*") if path.is_file()}
    assert {name for name, stored in files.items() if stored.startswith(PICTURES)} == set()
    for content in contents:
        assert {name for name, stored in files.items() if content[:1024] in stored} == set()


def is_whole(note: Path) -> bool:
    """Whether a note has its content: a kill may come between its creation and that."""
    try:
        digested_json.decoded(note.read_bytes())
    except ValueError:
        return False
    return True


def begin_visit(rig: Rig) -> str:
    visit: str = rig.request("POST", "/api/visits", json={"key": "0" * 16}).json()["id"]
    answer_consent(rig, visit, "agreed", "1" * 16)
    return visit


def answer_consent(rig: Rig, visit: str, value: str, key: str) -> None:
    rig.request("PATCH", f"/api/visits/{visit}", json={"key": key, "field": "consent", "value": value})


@dataclass
class Interrupted:
    """What a press left that ended with its process: visit, target, frames on the disk, and light counted."""

    visit: str | None
    target: CaptureTarget
    frames: dict[str, bytes]
    spent_j_per_cm2: float


Interrupt = Callable[..., Interrupted]


@pytest.fixture
def interrupt(build: Callable[..., Rig], tmp_path: Path) -> Interrupt:
    """Press, and end the exam in the exposure number `last`; `consent` is the answer that is given afterwards."""

    def press(last: int, of_visit: bool = True, consent: str = "agreed") -> Interrupted:
        with ExitStack() as undo:
            rig = build(tmp_path, undo, camera=lambda camera: EndsAt(camera, last))
            visit = begin_visit(rig) if of_visit else None
            pictures = VisitRepository(rig.store.engine, load_programme(), rig.clock).pictures
            target = pictures.capture_target("OD", KEY, visit, "R-centre" if of_visit else None)
            with pytest.raises(DiffuscopeError, match="unexpectedly"):
                rig.exam.press("OD", KEY, target).result(60)
            assert rig.died.wait(10)
            assert rig.world.illumination is None
            assert rig.store.captures() == []
            folder = rig.store.folder
            until(lambda: len(written(folder)) == last - 1)
            if visit is not None:
                answer_consent(rig, visit, consent, "2" * 16)
            return Interrupted(visit, target, written(folder), rig.exam.head.light.ledger.spent_j_per_cm2("OD"))

    return press


pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # on purpose


@pytest.mark.parametrize(("last", "lit", "dark"), [(3, 1, True), (5, 3, True), (6, 4, False)])
def test_the_next_start_stores_a_shorter_burst_under_the_same_id_and_key(
    build: Callable[..., Rig], interrupt: Interrupt, tmp_path: Path, last: int, lit: int, dark: bool
) -> None:
    before = interrupt(last)
    (folder,) = [path for path in (tmp_path / "store" / "journal").iterdir() if path.is_dir()]
    id = folder.name
    if not dark:  # the disk lost it
        del before.frames["dark.tiff"]
        (folder / "dark.tiff.json").unlink()
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        repeated = rig.exam.press("OD", KEY, before.target)
        capture = repeated.result(60)
        until(lambda: rig.exam.state == "aim")
        assert capture.id == id
        assert rig.store.captures() == [capture]
        assert rig.world.frames == 0, "nothing is exposed again"
        made = capture.report
        assert [frame.index for frame in made.frames] == list(range(lit))
        assert SHORTER.format(taken=lit, planned=4) in made.warnings
        assert bool({NO_DARK, CALIBRATION_DARK} & set(made.warnings)) is not dark
        assert made.method != "none"
        assert {channel.name: channel.reason for channel in made.channels}["red"] == INTERRUPTED
        green_j_per_cm2 = rig.exam.head.light.hazard.dose_j_per_cm2(
            Illumination("green"), lit * rig.exam.head.spec.camera.exposure_s
        )
        assert made.dose_j_per_cm2 == pytest.approx(green_j_per_cm2, rel=0.02)
        assert rig.exam.head.light.ledger.spent_j_per_cm2("OD") == pytest.approx(before.spent_j_per_cm2)
        for name, content in before.frames.items():
            assert rig.store.read(id, name) == content
        assert ("dark.tiff" in capture.files) is dark
        assert list((rig.store.folder / "journal").iterdir()) == []
        visit = rig.request("GET", f"/api/visits/{before.visit}").json()
        assert visit["slots"]["R-centre"]["captures"] == [id]


def test_no_file_of_the_data_folder_holds_a_frame_or_picture_without_encryption(
    build: Callable[..., Rig], interrupt: Interrupt, tmp_path: Path
) -> None:
    before = interrupt(3)
    assert len(before.frames) == 2
    refuse_plain(tmp_path / "store", before.frames.values())
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        capture = rig.exam.press("OD", KEY, before.target).result(60)
        until(lambda: rig.exam.state == "aim")
        test_picture = rig.exam.press("OS").result(60)
        until(lambda: rig.exam.state == "aim")
        kept = [(made.id, name) for made in (capture, test_picture) for name in made.files]
        assert {"raw.tiff", "picture.png", "quick.jpg", "report.json"} <= {name for _, name in kept}
        refuse_plain(rig.store.folder, [rig.store.read(id, name) for id, name in kept])
        patient_id = patient_of_visit(rig.store.engine, before.visit)
        rig.store.keys.erase(patient_id)
        for name in capture.files:
            answer = rig.request("GET", f"/api/captures/{capture.id}/{name}")
            assert (answer.status_code, answer.json()["code"]) == (410, "store.erased"), name
        assert rig.store.read(test_picture.id, "picture.png")


@pytest.mark.parametrize(("last", "frames"), [(1, set()), (2, {"dark.tiff"})])
def test_without_a_lit_frame_the_press_is_an_interrupted_capture(
    build: Callable[..., Rig], interrupt: Interrupt, tmp_path: Path, last: int, frames: set[str]
) -> None:
    before = interrupt(last, of_visit=False)
    assert set(before.frames) == frames
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        assert [capture.eye for capture in rig.exam.capture_journal.interrupted] == ["OD"]
        assert rig.exam.press("OD", KEY, before.target).result(60).report.method != "none"
        assert rig.world.frames > 0


def test_frames_of_a_patient_who_has_declined_since_are_deleted(
    build: Callable[..., Rig], interrupt: Interrupt, tmp_path: Path
) -> None:
    before = interrupt(4, consent="declined")
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        with pytest.raises(ConsentDeclined):
            rig.exam.press("OD", KEY, before.target).result(60)
        assert rig.store.captures() == []
        assert rig.exam.capture_journal.interrupted == ()
        assert list((rig.store.folder / "journal").iterdir()) == []


def test_frames_that_a_full_disk_refuses_wait_for_a_start_with_room(
    build: Callable[..., Rig], interrupt: Interrupt, tmp_path: Path
) -> None:
    before = interrupt(3)
    for _ in range(MAX_ATTEMPTS):
        with ExitStack() as undo:
            rig = build(tmp_path, undo, store={"free_bytes": lambda _: 0})
            with pytest.raises(StoreFull):
                rig.exam.press("OD", KEY, before.target).result(60)
            assert rig.exam.capture_journal.interrupted == ()
            assert written(rig.store.folder) == before.frames
            assert rig.world.illumination is None
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        kept = rig.exam.press("OD", KEY, before.target).result(60)
        assert set(before.frames) <= set(kept.files)
        assert rig.world.frames == 0, "nothing is exposed again"


class EndsAtMaking(EventBus):
    """Event bus that ends the exam once, when its state is that a capture is exposed and waits to be made."""

    has_ended = False

    def publish(self, kind: str, **data: object) -> None:
        if kind == "state" and data["state"] == "making" and not self.has_ended:
            self.has_ended = True
            raise ZeroDivisionError("unexpected")
        super().publish(kind, **data)


def test_the_error_of_a_press_that_was_exposed_says_that_its_frames_are_kept(
    build: Callable[..., Rig], tmp_path: Path
) -> None:
    """Also that of the next start, if it ends before the frames are reconstructed."""
    for _ in range(2):
        with ExitStack() as undo:
            rig = build(tmp_path, undo, event_bus=EndsAtMaking(), wait=False)
            with pytest.raises(Busy, match="before the picture was made") as ended:
                rig.exam.press("OD", KEY).result(60)
            assert ended.value.remedy == f"{UNTIL_BACK} {POSTPONED}"
            assert rig.died.wait(10)
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        made = rig.exam.press("OD", KEY).result(60)
        assert rig.world.frames == 0, "nothing is exposed again"
        assert len(made.report.frames) == 4


@pytest.mark.timeout(600)
def test_sigkill_between_frames_and_during_the_reconstruction(environment: dict[str, str], tmp_path: Path) -> None:
    """One press is killed after its second frame, the next one after its last; each request is repeated after a start.

    The exposures are long, so that the kill comes before the next frame also on a busy computer, and the lamp may be on
    for all of them.
    """
    head, data = tmp_path / "slow.toml", tmp_path / "data"
    slow = small_head_toml("Small slow head", summed=2, exposure_s=0.8)
    head.write_text(slow.replace("[light]", "[light]\nmax_on_s = 10"))
    server = Server(head, data, environment)
    with server.running() as process:
        ready(server)
        shorter = killed_press(server, process, data, "c" * 16, "raw-1.tiff")
    with server.running() as process:
        report = repeated_press(server, shorter)
        lit = [name for name in shorter.frames if name == "raw.tiff" or name[4:5].isdigit()]
        assert len(report["frames"]) == len(lit) < 4
        assert SHORTER.format(taken=len(lit), planned=4) in report["warnings"]
        assert list((data / "journal").iterdir()) == []
        whole = killed_press(server, process, data, "d" * 16, "raw-red.tiff")
        assert set(whole.frames) >= {"raw.tiff", "raw-1.tiff", "raw-2.tiff", "raw-3.tiff", "raw-red.tiff", "dark.tiff"}
    with server.running():
        report = repeated_press(server, whole)
        assert len(report["frames"]) == 4
        assert MADE_AT_START in report["warnings"]
        assert server.listed() == [whole.id, shorter.id]
    assert list((data / "journal").iterdir()) == []


@dataclass
class KilledPress:
    """A press whose server was killed: id of the capture, request, and frames on the disk."""

    id: str
    request: dict[str, str]
    frames: dict[str, bytes]


def killed_press(server: Server, process: subprocess.Popen[bytes], data: Path, key: str, last: str) -> KilledPress:
    """Press, and kill the server with SIGKILL as soon as the frame `last` is on the disk."""
    request = {"eye": "OD", "key": key}
    with ThreadPoolExecutor(1) as aside:
        pressed = aside.submit(server.ask, "POST", "/api/captures", request)
        until(lambda: any(map(is_whole, data.glob(f"journal/*/{last}.json"))) or pressed.done(), 300)
        process.send_signal(signal.SIGKILL)
        assert pressed.exception(60) is not None, "the kill came too late, so the test shows nothing"
    process.wait()
    (id,) = [path.name for path in (data / "journal").iterdir() if path.is_dir()]
    assert not (data / "captures" / id).exists(), "the kill came too late, so the test shows nothing"
    killed = KilledPress(id, request, written(data))
    refuse_plain(data, killed.frames.values())
    return killed


def repeated_press(server: Server, killed: KilledPress) -> Any:
    """Send the request of a killed press again; return the report of its capture, which has the frames on the disk."""
    ready(server)
    assert server.ask("POST", "/api/captures", killed.request)["id"] == killed.id
    report = server.ask("GET", f"/api/captures/{killed.id}/report.json")
    assert report["dose_j_per_cm2"] > 0
    for name, content in killed.frames.items():
        assert server.ask("GET", f"/api/captures/{killed.id}/{name}") == content
    return report


def ready(server: Server) -> None:
    until(lambda: server.ask("GET", "/api/status")["state"] == "aim", 300)
