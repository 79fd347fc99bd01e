"""A store that refuses after the light: what was exposed is stored later, in this run or at the next start."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import current_thread
from typing import Any

import pytest
from sqlalchemy import event, text

from device.errors import StoreError, StoreFull
from device.ports import Camera
from device.values import ExposureSettings, Frame
from services.errors import StoreLocked
from services.instrument.events import EventBus
from services.instrument.exam_loop import LOCK_PATIENCE_S
from services.instrument.resumption import MADE_AT_START
from services.records import schema
from services.records.capture_target import CaptureTarget
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository
from tests.journey.conftest import Rig, until
from tests.journey.test_interrupted_press import begin_visit

BUSY_MS = 50  # instead of the five seconds that a writer waits for another one
KEY = "c" * 16


class Moment(EventBus):
    """Event bus that runs `act` before the storage of the first capture, or with `lit` while its first light is on."""

    def __init__(self, lit: bool = False) -> None:
        super().__init__()
        self._is_pending, self._lit = True, lit
        self.act: Callable[[], object] = lambda: None

    def publish(self, kind: str, **data: Any) -> None:
        super().publish(kind, **data)
        if data.get("stage") == "keep" and not self._lit:
            self.happen()

    def happen(self) -> None:
        if self._is_pending:
            self._is_pending = False
            self.act()

    def camera(self, inner: Camera) -> "Camera":
        return WatchedCamera(inner, self) if self._lit else inner


class WatchedCamera:
    """Camera that reports the first frame in light, while the lamp is on."""

    def __init__(self, inner: Camera, moment: Moment) -> None:
        self._inner, self._moment, self.shape = inner, moment, inner.shape

    def prepare(self, shot: ExposureSettings) -> None:
        self._inner.prepare(shot)

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        frame = self._inner.expose(shot, into)
        if frame.illumination is not None:
            self._moment.happen()
        return frame

    def close(self) -> None:
        self._inner.close()


class OtherProgram:
    """Another program that holds the database of the store from `lock` to `unlock`."""

    def __init__(self, rig: Rig) -> None:
        self._connection = sqlite3.connect(
            rig.store.folder / schema.DATABASE, isolation_level=None, check_same_thread=False
        )
        self.has_lock = False

    def lock(self) -> None:
        self._connection.execute("BEGIN EXCLUSIVE").close()
        self.has_lock = True

    def unlock(self) -> None:
        self._connection.execute("ROLLBACK").close()

    def close(self) -> None:
        self._connection.close()


def wait_briefly(connection: Any, _entry: object) -> None:
    connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}").close()


@contextmanager
def locking(rig: Rig, moment: Moment) -> Iterator[OtherProgram]:
    """Another program locks the database at a moment; other writers wait for BUSY_MS only."""
    event.listen(rig.store.engine, "connect", wait_briefly)
    rig.store.engine.dispose()  # of the connections that wait for longer
    other = OtherProgram(rig)
    moment.act = other.lock
    yield other
    other.close()


def target(rig: Rig, visit: str) -> CaptureTarget:
    pictures = VisitRepository(rig.store.engine, load_programme(), rig.clock).pictures
    return pictures.capture_target("OD", KEY, visit, "R-centre")


def in_journal(rig: Rig) -> list[str]:
    """Return the names of the frames in the journal of captures in progress."""
    return sorted(path.name for path in (rig.store.folder / "journal").glob("*/*.tiff"))


@pytest.mark.parametrize("lit", [True, False], ids=["in the light", "before the storage"])
def test_a_lock_that_begins_after_the_dose_only_delays_the_picture(
    build: Callable[..., Rig], tmp_path: Path, lit: bool
) -> None:
    moment = Moment(lit)
    with ExitStack() as undo:
        rig = build(tmp_path, undo, event_bus=moment, camera=moment.camera)
        visit = begin_visit(rig)
        with locking(rig, moment) as other:
            pressed = rig.exam.press("OD", KEY, target(rig, visit))
            until(lambda: rig.exam.problem is not None, 30)
            assert other.has_lock
            assert isinstance(rig.exam.problem, StoreLocked)
            assert not pressed.done()
            assert "raw-3.tiff" in in_journal(rig)
            other.unlock()
            kept = pressed.result(60)
        until(lambda: rig.exam.state == "aim")
        assert rig.exam.problem is None
        assert rig.store.captures() == [kept]
        assert {"raw.tiff", "raw-1.tiff", "raw-2.tiff", "raw-3.tiff"} <= set(kept.files)
        assert list((rig.store.folder / "journal").iterdir()) == []
        assert rig.request("GET", f"/api/visits/{visit}").json()["slots"]["R-centre"]["captures"] == [kept.id]
        assert rig.world.illumination is None


def lose_patience(rig: Rig, moment: Moment, visit: str) -> None:
    """Press while another program locks the database for longer than a press waits."""
    with locking(rig, moment) as other:
        pressed = rig.exam.press("OD", KEY, target(rig, visit))
        until(lambda: rig.exam.problem is not None, 30)
        rig.clock.sleep(LOCK_PATIENCE_S)
        with pytest.raises(StoreLocked, match="locked") as raised:
            pressed.result(60)
        assert "next start" in raised.value.remedy
        other.unlock()


def fill_the_disk(rig: Rig, _: Moment, visit: str) -> None:
    """Press on a disk that is full for the thread that stores captures."""
    with pytest.raises(StoreFull) as raised:
        rig.exam.press("OD", KEY, target(rig, visit)).result(60)
    assert "next start" in raised.value.remedy


@pytest.mark.parametrize("refuse", [lose_patience, fill_the_disk])
def test_a_picture_that_cannot_be_stored_is_made_at_the_next_start(
    build: Callable[..., Rig], tmp_path: Path, refuse: Callable[[Rig, Moment, str], None]
) -> None:
    moment, is_full = Moment(), refuse is fill_the_disk
    store = {"free_bytes": lambda _: 0 if is_full and current_thread().name.startswith("aside") else 10**9}
    with ExitStack() as undo:
        rig = build(tmp_path, undo, event_bus=moment, store=store)
        visit = begin_visit(rig)
        refuse(rig, moment, visit)
        assert rig.store.captures() == []
        assert rig.exam.capture_journal.interrupted == (), "the page does not ask for it again"
        frames = in_journal(rig)
        assert len(frames) >= 5
        assert rig.world.illumination is None
        spent_j_per_cm2 = rig.exam.head.light.ledger.spent_j_per_cm2("OD")
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        until(lambda: rig.store.captures() != [], 60)
        (kept,) = rig.store.captures()
        assert set(frames) <= set(kept.files)
        assert MADE_AT_START in kept.report.warnings
        assert rig.world.frames == 0, "nothing is exposed again"
        assert rig.exam.head.light.ledger.spent_j_per_cm2("OD") == pytest.approx(spent_j_per_cm2)
        until(lambda: list((rig.store.folder / "journal").iterdir()) == [])
        assert rig.request("GET", f"/api/visits/{visit}").json()["slots"]["R-centre"]["captures"] == [kept.id]


def test_a_capture_whose_rows_can_never_be_written_leaves_no_frames(build: Callable[..., Rig], tmp_path: Path) -> None:
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        wrong = CaptureTarget(write_rows=lambda session, _: session.execute(text("SELECT nothing FROM nowhere")))
        with pytest.raises(StoreError):
            rig.exam.press("OD", KEY, wrong).result(60)
        until(lambda: list((rig.store.folder / "journal").iterdir()) == [])
