"""Removal of exported and sent pictures: its rule, its undoing, and what a reader sees meanwhile."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import StoreFull
from services.delivery.removal import PictureRemoval, reason_to_remove
from services.errors import RecordRemoved, StoreDamaged
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.export_records import ExportRecords
from services.records.programme import load_programme
from services.records.removed_captures import MARK, Removal, is_large
from services.records.store_check import check_store
from services.records.upload_queue import UploadQueue, UploadReceipt
from services.records.visit import Visit
from services.records.visit_repository import VisitRepository
from tests.store_damage import FILES

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
REMOVAL = Removal("sent", NOON)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        for id in ("a", "b"):
            opened.save(Capture(id, "OD", NOON, True, "00ff", CaptureReport(), {}), FILES)
        yield opened


def visit(finished_at: datetime | None) -> Visit:
    return Visit("v", "p", "A1", "2026-03-01", NOON, {}, {}, finished_at)


@pytest.mark.parametrize(
    ("finished_at", "sent", "exported_state", "reason"),
    [
        (NOON, ("v",), None, "sent"),
        (NOON, (), NOON, "exported"),
        (NOON, (), None, None),
        (None, ("v",), NOON, None),
        (NOON, (), NOON - timedelta(seconds=1), None),
    ],
)
def test_only_a_confirmed_copy_of_the_present_state_permits_a_removal(
    finished_at: datetime | None, sent: tuple[str, ...], exported_state: datetime | None, reason: str | None
) -> None:
    assert reason_to_remove(visit(finished_at), sent, exported_state) == reason


def test_removed_files_are_named_as_removed_and_come_back_bit_for_bit(store: CaptureStore) -> None:
    store.removed.remove(["a"], REMOVAL)
    for name in FILES:
        if is_large(name):
            with pytest.raises(RecordRemoved, match="removed on 2026-03-01, after its visit was sent"):
                store.read("a", name)
        else:
            assert store.read("a", name) == FILES[name]
        assert store.read("b", name) == FILES[name]
    assert store.get("a").id == "a"
    assert all(
        result.is_whole for result in check_store(store.folder, lambda line: None) if "ledger" not in result.name
    )
    assert store.removed.undo() == 1
    assert {name: store.read("a", name) for name in FILES} == FILES
    assert store.removed.removal("a") is None
    assert store.removed.undo() == 0


def test_removed_files_are_deleted_oldest_first_before_a_picture_is_refused(store: CaptureStore) -> None:
    store.removed.remove(["b"], REMOVAL)
    store.removed.remove(["a"], REMOVAL)
    names = list(store.removed.sizes_bytes())
    assert [name.partition("-")[2] for name in names] == ["b", "a"]
    with pytest.raises(StoreFull):
        store.space.make_room(10**15, 0)
    assert store.removed.sizes_bytes() == {}
    assert store.removed.undo() == 0
    with pytest.raises(RecordRemoved):
        store.read("a", "raw.tiff")


def test_removed_files_count_as_free_space(tmp_path: Path) -> None:
    free_bytes = [10**6]
    with CaptureStore(tmp_path, reserve_bytes=0, free_bytes=lambda _: free_bytes[0]) as store:
        for id in ("a", "b", "c"):
            store.save(Capture(id, "OD", NOON, True, "00ff", CaptureReport(), {}), FILES)
        free_bytes[0] = 0
        assert store.space.captures_left() == 0
        store.removed.remove(["a", "b", "c"], REMOVAL)
        assert store.space.captures_left() == 1  # of three; what stays of each is the rest


def test_a_rebuilt_database_knows_that_the_files_were_removed(store: CaptureStore) -> None:
    store.removed.remove(["a"], REMOVAL)
    (store.folder / "store.sqlite").unlink()
    store.close()
    for log in store.folder.glob("store.sqlite-*"):
        log.unlink()
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert sorted(again.recovery.adopted) == ["a", "b"]
        with pytest.raises(RecordRemoved):
            again.read("a", "raw.tiff")


def test_a_lost_file_is_not_called_removed(store: CaptureStore) -> None:
    (store.folder / "captures/a/raw.tiff").unlink()
    with pytest.raises(StoreDamaged):
        store.read("a", "raw.tiff")
    store.removed.remove(["b"], REMOVAL)
    (store.folder / "captures/b/report.json").unlink()
    with pytest.raises(StoreDamaged):
        store.read("b", "report.json")
    (store.folder / "captures/b" / MARK).write_bytes(b"{}")
    with pytest.raises(StoreDamaged, match="mark of the removal"):
        store.read("b", "raw.tiff")


def test_a_finished_visit_is_removable_once_it_was_sent_or_exported(tmp_path: Path) -> None:
    keys, clock = (f"{number:016x}" for number in count()), VirtualClock()
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        removal, finished = PictureRemoval(store, people, clock), list[Visit]()
        for number in range(3):
            id = people.begin(next(keys)).id
            people.answer(next(keys), id, "consent", "agreed")
            target = people.pictures.capture_target("OD", next(keys), id, "R-centre")
            report = CaptureReport(visit=id, slot="R-centre")
            taken = Capture(f"c{number}", "OD", clock.wall(), True, "00ff", report, {})
            store.save(taken, FILES, target.write_rows, target.request)
            clock.sleep(1)
            finished.append(people.finish(next(keys), id))
        assert removal.removable().visits == 0
        queue, exports = UploadQueue(store.engine, clock), ExportRecords(store.folder)
        sent = next(entry for entry in queue.queued() if entry.visit == finished[0].id)
        queue.record_success(sent, UploadReceipt("0" * 64, "sha256"))
        state = finished[1].finished_at
        assert state is not None
        exports.write(finished[1].id, state, clock.wall())
        found = removal.removable()
        assert (found.visits, found.captures) == (2, {"exported": ["c1"], "sent": ["c0"]})
        places = [tmp_path / "store" / "captures" / id for id in ("c0", "c1")]
        large = [path for place in places for path in place.iterdir() if is_large(path.name)]
        assert found.size_bytes == sum(path.stat().st_size for path in large)
        assert len(large) == 2 * sum(map(is_large, FILES))
        removal.remove()
        assert removal.removable().visits == 0
        assert removal.undoable()[0] == 2
        with pytest.raises(RecordRemoved, match="exported"):
            store.read("c1", "picture.png")
        assert store.read("c2", "picture.png") == FILES["picture.png"]
        people.reopen(next(keys), finished[1].id, "picture")
        assert removal.undo() == 2
        assert removal.removable().captures == {"exported": [], "sent": ["c0"]}, "reopened: another state"
