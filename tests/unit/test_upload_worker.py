"""Upload queue and worker: each finished visit arrives once, under every sequence of errors."""

import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from device.clock import VirtualClock
from device.errors import DiffuscopeError
from device.values import Eye
from services.delivery.upload_worker import BACKOFF_FIRST_S, BACKOFF_MAX_S, UploadCounts, UploadWorker, archive_builder
from services.delivery.uploader import VisitArchive
from services.errors import (
    Busy,
    ReceiverUnreachable,
    ReceiverUntrusted,
    UploadMismatch,
    UploadRejected,
    UploadUnauthorised,
)
from services.health.alerts import upload_alerts
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.upload_queue import STUCK_AFTER, UploadQueue, UploadReceipt
from services.records.visit_repository import VisitRepository

keys = (f"{number:016x}" for number in count(1))
MEMORY = Path("/dev/shm")
LINK = ReceiverUnreachable("no answer")


@dataclass
class QueueSetup:
    """A capture store with a visit repository and an upload queue, in virtual time."""

    store: CaptureStore
    clock: VirtualClock
    repository: VisitRepository = field(init=False)
    queue: UploadQueue = field(init=False)

    def __post_init__(self) -> None:
        self.repository = VisitRepository(self.store.engine, load_programme(), self.clock)
        self.queue = UploadQueue(self.store.engine, self.clock)

    def begin(self) -> str:
        self.clock.sleep(60)
        return self.repository.answer(next(keys), self.repository.begin(next(keys)).id, "consent", "agreed").id

    def finish(self, visit: str) -> str:
        self.clock.sleep(1)
        return self.repository.finish(next(keys), visit).id

    def finished_visit(self) -> str:
        return self.finish(self.begin())

    def reopen(self, visit: str) -> None:
        self.repository.reopen(next(keys), visit, "mistake")

    def take(self, visit: str, slot: str = "R-centre") -> None:
        self.clock.sleep(1)
        eye: Eye = "OD" if slot[0] == "R" else "OS"
        target = self.repository.pictures.capture_target(eye, None, visit, slot)
        report = CaptureReport(visit=visit, slot=slot)
        id = f"{self.clock.wall():%Y%m%dT%H%M%S}-{eye}"
        capture = Capture(id, eye, self.clock.wall(), True, "00ff", report, {})
        self.store.save(capture, {"picture.png": b"png", "report.json": b"{}", "raw.tiff": b"raw"}, target.write_rows)

    def queued(self) -> list[str]:
        return [entry.visit for entry in self.queue.queued()]


@pytest.fixture
def setup() -> Iterator[QueueSetup]:
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        CaptureStore(Path(folder), reserve_bytes=0) as store,
    ):
        yield QueueSetup(store, VirtualClock(datetime(2026, 3, 1, tzinfo=UTC)))


@dataclass
class FakeUploader:
    """Fake uploader: records the uploaded archives, and raises the given errors, one per upload."""

    errors: list[DiffuscopeError] = field(default_factory=list)
    uploaded: list[VisitArchive] = field(default_factory=list)
    attempts: int = 0
    before_result: Callable[[], None] = lambda: None
    aborted: bool = False

    def upload(self, archive: VisitArchive, pause: Callable[[], None]) -> UploadReceipt:
        self.attempts += 1
        pause()
        self.before_result()
        if self.errors:
            raise self.errors.pop(0)
        self.uploaded.append(archive)
        return UploadReceipt(archive.sha256, "sha256")

    def abort(self) -> None:
        self.aborted = True


def worker_of(setup: QueueSetup, uploader: FakeUploader, is_idle: Callable[[], bool] = lambda: True) -> UploadWorker:
    return UploadWorker(
        setup.queue,
        archive_builder(setup.store, setup.repository),
        uploader,
        is_idle,
        setup.clock,
        random_share=lambda: 0.0,
    )


def active_alerts(worker: UploadWorker) -> dict[str, dict[str, object]]:
    found = {alert.code: alert.facts() for alert in upload_alerts(worker.queue.status())}
    return {code: {name: value for name, value in facts.items() if name != "code"} for code, facts in found.items()}


# Queue


def test_a_finish_queues_a_visit_and_an_undo_removes_it(setup: QueueSetup) -> None:
    visit = setup.begin()
    assert setup.queued() == []
    setup.finish(visit)
    assert setup.queued() == [visit]
    setup.reopen(visit)
    assert (setup.queued(), setup.queue.status().waiting) == ([], 0)
    setup.finish(visit)
    setup.queue.record_success(setup.queue.queued()[0], UploadReceipt("0" * 64, "sha256"))
    assert setup.queued() == []
    assert setup.queue.uploaded_count(setup.repository.get(visit).day) == 1
    setup.reopen(visit)
    assert setup.queued() == []
    setup.finish(visit)
    assert setup.queued() == [visit]
    assert setup.queue.uploaded_count(setup.repository.get(visit).day) == 0


def test_a_visit_that_changed_during_its_upload_is_queued_again(setup: QueueSetup) -> None:
    visit = setup.finished_visit()
    (uploading,) = setup.queue.queued()
    setup.reopen(visit)
    setup.queue.record_success(uploading, UploadReceipt("0" * 64, "sha256"))
    assert setup.queued() == []
    setup.finish(visit)
    assert setup.queued() == [visit]


def test_a_capture_after_the_finish_queues_the_visit_again(setup: QueueSetup) -> None:
    visit = setup.begin()
    target = setup.repository.pictures.capture_target("OD", None, visit, "R-centre")
    setup.finish(visit)
    uploader = FakeUploader()
    assert worker_of(setup, uploader).step()
    report = CaptureReport(visit=visit, slot="R-centre")
    capture = Capture("late", "OD", setup.clock.wall(), True, "00ff", report, {})
    setup.clock.sleep(1)
    setup.store.save(capture, {"picture.png": b"png", "report.json": b"{}"}, target.write_rows)
    assert setup.queued() == [visit]
    assert worker_of(setup, uploader).step()
    assert [len(archive_names(parcel)) for parcel in uploader.uploaded] == [3, 5]


def archive_names(parcel: VisitArchive) -> list[str]:
    with zipfile.ZipFile(io.BytesIO(parcel.content)) as archive:
        return archive.namelist()


def test_queued_visits_have_a_size_and_are_ordered_by_finish(setup: QueueSetup) -> None:
    first, second = setup.begin(), setup.begin()
    setup.take(second)
    setup.take(second)
    for visit in (second, first):
        setup.finish(visit)
    places = setup.store.folder / "captures"
    sent_bytes = [path.stat().st_size for name in ("picture.png", "report.json") for path in places.glob(f"*/{name}")]
    assert len(sent_bytes) == 4
    found = setup.queue.queued(sizes=True)
    assert [(entry.visit, entry.size_bytes) for entry in found] == [(second, sum(sent_bytes)), (first, 0)]
    assert [entry.visit for entry in setup.queue.queued(1)] == [second]


# Worker


def test_each_visit_is_uploaded_once_oldest_first_and_is_content_addressed(setup: QueueSetup) -> None:
    visits = [setup.finished_visit() for _ in range(3)]
    uploader = FakeUploader()
    worker = worker_of(setup, uploader)
    while worker.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in uploader.uploaded] == visits
    assert all(parcel.sha256[:16] in parcel.name for parcel in uploader.uploaded)
    assert worker.counts() == UploadCounts(3, 0)
    assert active_alerts(worker) == {}


def test_an_archive_does_not_depend_on_the_date(setup: QueueSetup) -> None:
    """`undo_until` ends at midnight; a name that depended on it would cause a second upload of every visit."""
    visit = setup.finished_visit()
    pack = archive_builder(setup.store, setup.repository)
    today = pack(visit)
    setup.clock.sleep(2 * 86400)
    assert pack(visit) == today
    assert b"undo_until" not in today.content


def test_no_upload_starts_during_an_exam(setup: QueueSetup) -> None:
    setup.finished_visit()
    idle = [False]
    uploader = FakeUploader()
    worker = worker_of(setup, uploader, lambda: idle[0])
    assert not worker.step()
    idle[0] = True
    uploader.errors = [Busy("an exam is active")]
    assert not worker.step()
    assert (uploader.attempts, setup.queue.queued()[0].tries, worker.backoff_s) == (1, 0, 0), "Busy is no failure"
    assert worker.step()


def test_an_upload_pauses_during_an_exam_and_is_aborted_if_it_is_long(setup: QueueSetup) -> None:
    setup.finished_visit()
    idle_results = iter([True, *[False] * 3, True])
    worker = worker_of(setup, FakeUploader(), lambda: next(idle_results))
    assert worker.step()
    setup.finished_visit()
    idle_results = iter([True])

    def never() -> bool:
        setup.clock.sleep(5)
        return next(idle_results, False)

    worker = worker_of(setup, FakeUploader(), never)
    assert not worker.step()
    assert setup.queue.queued()[0].tries == 0


@given(st.integers(1, 9), st.floats(0, 1))
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_upload_is_retried_with_exponential_backoff_and_jitter(
    setup: QueueSetup, failures: int, random_share: float
) -> None:
    if not setup.queued():
        setup.finished_visit()
    uploader = FakeUploader([LINK] * failures)
    worker = UploadWorker(
        setup.queue,
        archive_builder(setup.store, setup.repository),
        uploader,
        lambda: True,
        setup.clock,
        random_share=lambda: random_share,
    )
    for number in range(failures):
        assert worker.step()
        longest_s = min(BACKOFF_FIRST_S * 2**number, BACKOFF_MAX_S)
        assert 0.8 * longest_s <= worker.backoff_s <= longest_s
        setup.clock.sleep(worker.backoff_s - 0.5)
        assert not worker.step()
        setup.clock.sleep(0.6)
    assert worker.step(), "uploaded when the link works again"
    assert len(uploader.uploaded) == 1
    setup.finished_visit()
    uploader.errors = [LINK]
    worker.step()
    assert worker.backoff_s <= BACKOFF_FIRST_S, "a success resets the backoff"
    setup.clock.sleep(BACKOFF_FIRST_S)
    worker.step()


def test_an_unreachable_receiver_is_an_alert_for_all_queued_visits(setup: QueueSetup) -> None:
    for _ in range(3):
        setup.finished_visit()
    uploader = FakeUploader([LINK])
    worker = worker_of(setup, uploader)
    assert active_alerts(worker) == {}, "a queued visit without an error is no alert"
    worker.step()
    assert uploader.attempts == 1, "one attempt stands for all"
    assert active_alerts(worker) == {"send.waiting": {"n": 3}}
    setup.clock.sleep(STUCK_AFTER.total_seconds() - 60)
    assert active_alerts(worker) == {"send.waiting": {"n": 3}}
    setup.clock.sleep(120)
    assert active_alerts(worker) == {"send.stuck": {"n": 3, "date": "2026-03-01"}}
    for _ in range(3):
        assert worker.step()
    assert active_alerts(worker) == {}


@pytest.mark.parametrize("kind", [ReceiverUntrusted, UploadUnauthorised])
def test_an_authentication_error_is_an_alert_at_once_and_is_retried(
    setup: QueueSetup, kind: type[DiffuscopeError]
) -> None:
    for _ in range(2):
        setup.finished_visit()
    uploader = FakeUploader([kind("no"), kind("no")])
    worker = worker_of(setup, uploader)
    worker.step()
    assert active_alerts(worker) == {"send.stuck": {"n": 2, "date": "2026-03-01"}}
    setup.clock.sleep(BACKOFF_FIRST_S)
    assert worker.step()
    setup.clock.sleep(2 * BACKOFF_FIRST_S)
    while worker.step():
        pass
    assert active_alerts(worker) == {}
    assert len(uploader.uploaded) == 2


@pytest.mark.parametrize("kind", [UploadRejected, UploadMismatch])
def test_a_rejected_visit_becomes_a_dead_letter_and_does_not_block_others(
    setup: QueueSetup, kind: type[DiffuscopeError]
) -> None:
    refused, other = setup.finished_visit(), setup.finished_visit()
    uploader = FakeUploader([kind("not this one")])
    worker = worker_of(setup, uploader)
    while worker.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in uploader.uploaded] == [other]
    setup.clock.sleep(30 * 86400)
    assert not worker.step(), "a dead letter is not retried"
    assert active_alerts(worker)["send.stuck"]["n"] == 1
    entry = setup.queue.queued()[0]
    assert (entry.visit, entry.error, entry.message) == (refused, kind.code, "not this one")
    worker.retry_now("another-visit")
    assert not worker.step()
    worker.retry_now(refused)
    assert active_alerts(worker) == {}
    assert worker.step()
    assert setup.queued() == []


def test_a_visit_with_a_damaged_picture_does_not_block_others(setup: QueueSetup) -> None:
    damaged = setup.begin()
    setup.take(damaged)
    setup.finish(damaged)
    other = setup.finished_visit()
    (picture,) = (setup.store.folder / "captures").glob("*/picture.png")
    picture.write_bytes(b"something else")
    uploader = FakeUploader()
    worker = worker_of(setup, uploader)
    while worker.step():
        pass
    assert [parcel.stem.split("-", 1)[1] for parcel in uploader.uploaded] == [other]
    assert setup.queue.queued()[0].error == "store.damaged"
    assert active_alerts(worker)["send.stuck"]["n"] == 1


def test_the_backoff_does_not_overflow(setup: QueueSetup) -> None:
    worker = worker_of(setup, FakeUploader([LINK]))
    for _ in range(1100):  # 2.0 ** 1024 overflows
        worker._back_off()
    assert worker.backoff_s == BACKOFF_MAX_S
    setup.clock.sleep(BACKOFF_MAX_S)
    setup.finished_visit()
    assert worker.step()
    assert worker.backoff_s == BACKOFF_MAX_S


def test_a_visit_that_was_reopened_during_a_failed_upload_is_no_alert(setup: QueueSetup) -> None:
    visit = setup.finished_visit()
    worker = worker_of(setup, FakeUploader([LINK], before_result=lambda: setup.reopen(visit)))
    assert worker.step()
    assert active_alerts(worker) == {}
    setup.clock.sleep(BACKOFF_FIRST_S)
    setup.finish(visit)
    assert setup.queue.queued()[0].tries == 0


def test_retry_now_skips_the_backoff(setup: QueueSetup) -> None:
    setup.finished_visit()
    worker = worker_of(setup, FakeUploader([LINK]))
    worker.step()
    assert not worker.step()
    worker.retry_now()
    assert worker.step()
    assert setup.queued() == []


def test_errors_persist_across_a_restart_and_the_backoff_does_not(setup: QueueSetup) -> None:
    setup.finished_visit()
    worker_of(setup, FakeUploader([LINK])).step()
    setup.clock.sleep(STUCK_AFTER.total_seconds() + 1)
    again = worker_of(setup, FakeUploader())
    assert active_alerts(again) == {"send.stuck": {"n": 1, "date": "2026-03-01"}}
    assert again.backoff_s == 0
    assert again.step()


def test_the_worker_thread_uploads_and_stops(setup: QueueSetup) -> None:
    for _ in range(3):
        setup.finished_visit()
    uploader = FakeUploader()
    worker = worker_of(setup, uploader)
    worker.begin()
    worker.retry_now()
    worker.close()
    assert uploader.aborted
    worker.begin()
    end = datetime.now(UTC) + timedelta(seconds=20)
    while setup.queue.status().waiting:
        assert datetime.now(UTC) < end
    worker.close()
    assert len(uploader.uploaded) >= 3


action_lists = st.lists(
    st.sampled_from(["begin", "take", "finish", "reopen", "send", "fail", "lose", "refuse", "try"]), max_size=25
)


@given(action_lists)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_finished_visit_is_uploaded_once_under_any_sequence_of_events(actions: list[str]) -> None:
    """The receiver ends with the last finished state of every visit, without duplicates."""
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        CaptureStore(Path(folder), reserve_bytes=0) as store,
    ):
        setup, uploader = QueueSetup(store, VirtualClock(datetime(2026, 3, 1, tzinfo=UTC))), FakeUploader()
        worker = worker_of(setup, uploader)
        for action in actions:
            perform(setup, uploader, worker, action)
        uploader.errors = []
        worker.retry_now()
        while worker.step():
            pass
        pack, received = archive_builder(store, setup.repository), {parcel.name: parcel for parcel in uploader.uploaded}
        done = [visit.id for visit in setup.repository.visits(100, open=False)]
        assert {pack(id).name for id in done} <= received.keys()
        assert setup.queued() == []
        assert active_alerts(worker) == {}


def perform(setup: QueueSetup, uploader: FakeUploader, worker: UploadWorker, action: str) -> None:
    opened = setup.repository.visits(1, open=True)
    closed = setup.repository.visits(1, open=False)
    errors = {"fail": LINK, "refuse": UploadRejected("no")}
    if action == "begin":
        setup.begin()
    elif action in ("take", "finish") and opened:
        getattr(setup, action)(opened[0].id)
    elif action == "reopen" and closed:
        setup.reopen(closed[0].id)
    elif action in errors:
        uploader.errors = [errors[action]]
        worker.step()
        uploader.errors = []
        setup.clock.sleep(60)
    elif action == "lose" and setup.queued():  # uploaded, but the answer was lost
        uploader.uploaded.append(archive_builder(setup.store, setup.repository)(setup.queued()[0]))
        setup.queue.record_failure(setup.queue.queued(1), LINK)
    elif action == "try":
        worker.retry_now()
    elif action == "send":
        worker.step()
