"""Key of a store: a record or dose ledger that another program wrote is refused, also with right digests."""

import json
import random
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device.clock import VirtualClock
from device.light_safety.dose_ledger import DoseLedgerState
from services.errors import StoreDamaged
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_log import LOG, DoseLedgerLog
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.record_document import RecordDocument, parse_document
from services.records.record_files import KEY_ID, RecordFiles
from services.records.schema import DATABASE
from services.records.store_check import Checked, check_store
from services.records.visit_repository import VisitRepository

KEY = bytes(range(32))
EDITS = 1000


def visits_of(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), VirtualClock())


@pytest.fixture
def visit(tmp_path: Path) -> str:
    """Id of a visit with a vision of 6/60, in a store with a key."""
    with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
        id = visits_of(store).begin("0" * 16).id
        visits_of(store).answer("1" * 16, id, "vision_od", "6/60")
    return id


def rewrite(folder: Path, visit: str) -> None:
    """Rewrite the file of a visit as a later one with a right digest and a vision of 6/6."""
    path = RecordFiles(folder).path("visit", visit)
    text = path.read_text()
    assert "6/60" in text
    changed = json.loads(text.replace("6/60", "6/6"))
    document = RecordDocument("visit", changed["revision"] + 1, changed["record"])
    path.write_text(json.dumps(changed | {"revision": document.revision, "sha256": document.sha256()}))
    assert parse_document(path.read_bytes()) == document, "its digest is right"


def checked_visits(folder: Path) -> Checked:
    (visits,) = (result for result in check_store(folder, str, KEY) if result.name == "visits")
    return visits


def test_a_rewritten_visit_changes_no_answer(tmp_path: Path, visit: str) -> None:
    rewrite(tmp_path, visit)
    assert checked_visits(tmp_path).healable == [visit]
    with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
        assert visits_of(store).get(visit).fields["vision_od"] == "6/60"
    assert checked_visits(tmp_path).is_whole


def test_a_rewritten_visit_is_not_restored_into_a_lost_database(tmp_path: Path, visit: str) -> None:
    rewrite(tmp_path, visit)
    (tmp_path / DATABASE).unlink()
    with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
        assert (len(store.recovery.patients), store.recovery.visits) == (1, [])
    assert checked_visits(tmp_path).damaged == [visit]


@pytest.mark.parametrize("without_database", [False, True])
@pytest.mark.parametrize("note", [None, b"0" * 64])
def test_a_removed_or_changed_note_of_the_key_makes_no_file_new(
    tmp_path: Path, visit: str, without_database: bool, note: bytes | None
) -> None:
    with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
        DoseLedgerStore(store.engine, VirtualClock(), 86_400.0)
    rewrite(tmp_path, visit)
    (tmp_path / KEY_ID).unlink()
    if note is not None:
        (tmp_path / KEY_ID).write_bytes(note)
    if without_database:
        (tmp_path / DATABASE).unlink()
    for _ in range(2):
        with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
            if without_database:
                assert store.recovery.visits == []
            else:
                assert visits_of(store).get(visit).fields["vision_od"] == "6/60"
    assert checked_visits(tmp_path).is_whole is not without_database


@pytest.mark.parametrize("without_database", [False, True])
def test_a_copy_without_its_key_keeps_its_records_and_tells_no_patient(
    tmp_path: Path, visit: str, without_database: bool
) -> None:
    """It takes its files as they are, once, and writes all of them with its own key; the patients stay encrypted."""
    with CaptureStore(tmp_path, reserve_bytes=0, key=KEY) as store:
        store.save(
            Capture("kept", "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"}
        )
    if without_database:
        (tmp_path / DATABASE).unlink()
    for _ in range(2):
        with CaptureStore(tmp_path, reserve_bytes=0, key=KEY[::-1]) as store:
            assert (visits_of(store).visits(10), visits_of(store).damaged()) == ([], 1)
            with pytest.raises(StoreDamaged, match="key"):
                visits_of(store).get(visit)
            assert [capture.id for capture in store.captures()] == ["kept"]
        for kind, id in (("capture", "kept"), ("visit", visit)):
            assert RecordFiles(tmp_path, KEY[::-1]).read(kind, id) is not None
        (tmp_path / DATABASE).unlink()


def paths_in(value: object) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each value that is no object or list."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        yield ()
        return
    for name, entry in items:
        yield from ((name, *rest) for rest in paths_in(entry))


def edited(value: dict[str, Any], seed: random.Random) -> dict[str, Any]:
    """Return a JSON object in which one value differs or is gone."""
    copy = json.loads(json.dumps(value))
    *parents, last = seed.choice(list(paths_in(copy)))
    inner = copy
    for name in parents:
        inner = inner[name]
    if seed.random() < 0.3:
        del inner[last]
    else:
        inner[last] = seed.choice([0, 1, 999_999, "6/6", "", None, [], seed.random()])
    return edited(value, seed) if copy == value else copy


def test_every_edit_of_a_record_with_a_right_digest_is_found(tmp_path: Path, visit: str) -> None:
    seed = random.Random(46)
    content = RecordFiles(tmp_path).path("visit", visit).read_bytes()
    entries = json.loads(content)
    assert parse_document(content, KEY).id == visit
    for _ in range(EDITS):
        record = edited(entries["record"], seed)
        revision = entries["revision"] + seed.randrange(3)
        digest = RecordDocument("visit", revision, record).sha256()
        forged = json.dumps(entries | {"revision": revision, "record": record, "sha256": digest}).encode()
        assert parse_document(forged).revision == revision, "its digest is right"
        with pytest.raises(ValueError, match="HMAC"):
            parse_document(forged, KEY)


def test_every_edit_of_a_dose_ledger_with_a_right_checksum_is_found(tmp_path: Path) -> None:
    """An edited line counts as none: the line before it is the newest."""
    seed = random.Random(46)
    log = DoseLedgerLog(tmp_path, KEY)
    first = DoseLedgerState({("OD", 1): 0.5}, 7.0, "boot", 5.0)
    log.append(first)
    begin = (tmp_path / LOG).read_bytes()
    log.append(DoseLedgerState({("OD", 1): 0.9, ("OS", 1): 0.1}, 8.0, "boot", 6.0))
    entry = json.loads((tmp_path / LOG).read_bytes().splitlines()[-1].partition(b" ")[2])
    for _ in range(EDITS):
        content = json.dumps(edited(entry, seed)).encode()
        (tmp_path / LOG).write_bytes(begin + b"\n%08x %b\n" % (zlib.crc32(content), content))
        assert log.newest() == first
