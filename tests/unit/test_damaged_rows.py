"""Damaged rows: lists, counts and the next start work without the damaged capture or visit."""

import json
import random
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import DiffuscopeError
from services.errors import RecordNotFound, StoreDamaged
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import CaptureJournal
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.quarantine import REQUIRED_FILES
from services.records.upload_queue import UploadQueue
from services.records.visit_document import visit_document
from services.records.visit_repository import VisitRepository

FILES = dict.fromkeys(sorted(REQUIRED_FILES), b"content")
REPORT = {
    "method": "variation",
    "seconds": {"expose": 0.25, "solve": 0.125},
    "budget_s": 10.5,
    "warnings": ["dim"],
    "refraction_dpt": {"sphere": -1.25, "sd": 0.5},
    "verdict": {"word": "good", "code": None, "numbers": {"a": 123456}},
    "laterality": {"eye": "OS", "score": 0.5},
    "dose_j_per_cm2": 0.0625,
    "note": "\u00e9",
}
TABLES = {
    "captures": ("id", "eye", "taken_at", "calibration_id", "report"),
    "files": ("capture_id", "name", "sha256"),
    "visits": ("id", "patient", "day", "begun_at", "finished_at", "outcome"),
    "answers": ("visit", "name", "value"),
    "changes": ("visit", "at", "user", "field", "was", "value"),
    "capture_slots": ("capture", "visit", "slot"),
    "slot_decisions": ("visit", "slot", "capture"),
    "uploads": ("visit", "finished_at", "failing_since", "error", "message"),
    "patients": ("patient_id", "made_at", "identity"),
    "observed_time": ("boot",),
    "doses": ("eye",),
    "idempotency_keys": ("key", "answer", "done_at"),
}
TURNS = 4
DISTINCT = 8  # length from which a text occurs in rows and indices only, not in the schema
COLUMNS = [(table, column) for table, columns in TABLES.items() for column in columns]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store with three visits and a capture in each; two visits are finished and queued for upload."""
    folder, clock = tmp_path_factory.mktemp("filled"), VirtualClock()
    keys = (f"{number:016x}" for number in count())
    with CaptureStore(folder, reserve_bytes=0) as store:
        people, light = (
            VisitRepository(store.engine, load_programme(), clock),
            DoseLedgerStore(store.engine, clock, 86_400.0, "boot"),
        )
        for number in range(3):
            visit = people.begin(next(keys)).id
            people.answer(next(keys), visit, "consent", "agreed", "Screener")
            people.answer(next(keys), visit, "complaints", ["flashes", "red"], "Screener")
            people.answer(next(keys), visit, "name", f"Name{number}", "Screener")
            target = people.pictures.capture_target("OD", next(keys), visit, "R-centre")
            report = CaptureReport.read(REPORT | {"visit": visit, "slot": "R-centre"})
            taken = Capture(f"c{number}", "OD", clock.wall(), True, "00ff", report, {})
            store.save(taken, FILES, target.write_rows)
            people.pictures.accept_capture(next(keys), f"c{number}")
            if number:
                people.finish(next(keys), visit, "Screener")
            light.reserve(("OD",), 0.001, 10.0)
            clock.sleep(1)
        UploadQueue(store.engine, clock).record_failure(
            UploadQueue(store.engine, clock).queued(), DiffuscopeError("no way")
        )
    return folder


def copied(filled: Path, to: Path) -> Path:
    to.mkdir()
    for path in sorted(filled.rglob("*")):
        if path.is_dir():
            (to / path.relative_to(filled)).mkdir()
        else:
            (to / path.relative_to(filled)).write_bytes(path.read_bytes())
    return to


def corrupt(folder: Path, table: str, column: str, random_source: random.Random) -> str:
    """Change one byte of a text of that column, in the row with its indices or at one place of the file."""
    path = folder / "store.sqlite"
    with closing(database(folder)) as tables:
        tables.text_factory = bytes
        rows = tables.execute(f"SELECT rowid, {column} FROM {table} WHERE {column} IS NOT NULL").fetchall()
        rowid, content = random_source.choice(rows)
        at = random_source.randrange(len(content))
        corrupted = bytearray(content)
        corrupted[at] = random_source.choice([byte for byte in range(1, 256) if byte != content[at]])
        if len(content) < DISTINCT or random_source.random() < 0.5:
            change = f"UPDATE OR IGNORE {table} SET {column} = CAST(? AS TEXT) WHERE rowid = ?"
            tables.execute(change, (bytes(corrupted), rowid))
            return f"row {rowid} of {table}.{column}: {content!r} -> {bytes(corrupted)!r}"
    file = path.read_bytes()
    places = [place.start() for place in re.finditer(re.escape(content), file)]
    place = random_source.choice(places)
    path.write_bytes(file[:place] + bytes(corrupted) + file[place + len(corrupted) :])
    return f"{content!r} -> {bytes(corrupted)!r}, {places.index(place) + 1} of {len(places)} in the file"


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_corrupted_byte_in_any_column_breaks_no_list_no_count_and_no_start(
    filled: Path, tmp_path: Path, table: str, column: str
) -> None:
    random_source = random.Random(f"{table}.{column}")
    for turn in range(TURNS):
        folder = copied(filled, tmp_path / f"{turn}")
        change_made = corrupt(folder, table, column, random_source)
        with CaptureStore(folder, reserve_bytes=0) as store:
            assert_all_queries_work(store, change_made)


def assert_all_queries_work(store: CaptureStore, change_made: str) -> None:
    people, clock = VisitRepository(store.engine, load_programme(), VirtualClock()), VirtualClock()
    captures, visits = store.captures(2), people.visits(10)
    captures += store.captures(5, before=captures[-1].id)
    if change_made.startswith(
        "row"
    ):  # after damage to an index alone, lists follow the index and counts follow the row
        assert {capture.id for capture in captures} >= {"c0", "c1", "c2"}, f"{change_made}: not healed"
        assert store.damaged() <= 1, change_made  # a row whose id changed stays, and its capture is adopted again
        assert len(visits) + people.damaged() == 3, change_made
    written = (
        [visit_document(visit).model_dump(mode="json") for visit in visits],
        [capture.report.as_json() for capture in captures],
    )
    json.dumps(written, allow_nan=False, ensure_ascii=False).encode()
    assert set(people.counts()) == {"done", "to_finish", "referred", "declined"}
    people.pictures.laterality_question()
    queue = UploadQueue(store.engine, clock)
    assert queue.status().waiting <= 2
    for waiting in queue.queued(sizes=True):
        with suppress(StoreDamaged):
            queue.record_failure([waiting], DiffuscopeError("no way"))
    CaptureJournal(store)
    assert DoseLedgerStore(store.engine, clock, 86_400.0).spent_j_per_cm2("OD") >= 0.003 - 1e-9, change_made
    assert store.space.captures_left() > 0
    assert store.space.visits_left(4) > 0
    for id in ("c0", "c1", "c2"):
        with suppress(StoreDamaged, RecordNotFound):
            store.get(id)
        with suppress(StoreDamaged, RecordNotFound):
            assert store.read(id, "raw.tiff") == b"content"
    assert {path.name for path in (store.folder / "captures").iterdir()} == {"c0", "c1", "c2"}, change_made


def database(folder: Path) -> sqlite3.Connection:
    tables = sqlite3.connect(folder / "store.sqlite", isolation_level=None)
    tables.execute("PRAGMA ignore_check_constraints = ON")
    return tables


@pytest.fixture
def store(filled: Path, tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(copied(filled, tmp_path / "own"), reserve_bytes=0) as store:
        yield store


def test_a_damaged_capture_is_refused_and_counted_and_its_files_stay_readable(store: CaptureStore) -> None:
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET report = replace(report, ':', ';') WHERE id = 'c1'")
    assert [capture.id for capture in store.captures()] == ["c2", "c0"]
    assert [capture.id for capture in store.captures(1, before="c2")] == ["c0"]
    assert store.damaged() == 1
    with pytest.raises(StoreDamaged, match="entry of 'c1' cannot be read") as raised:
        store.get("c1")
    assert "call the technician" in raised.value.remedy.lower()
    assert store.read("c1", "raw.tiff") == b"content"
    people = VisitRepository(store.engine, load_programme(), VirtualClock())
    assert [visit.slots["R-centre"].captures[0].capture for visit in people.visits(10)] == ["c2", "c1", "c0"]


def test_a_damaged_visit_is_refused_and_counted(store: CaptureStore) -> None:
    people = VisitRepository(store.engine, load_programme(), VirtualClock())
    newest, middle, _ = people.visits(10)
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE visits SET outcome = CAST(x'7bff' AS TEXT) WHERE id = ?", (middle.id,))
        tables.execute("UPDATE answers SET value = '[' WHERE visit = ?", (newest.id,))
    assert len(people.visits(10)) == 1
    assert people.damaged() == 2
    for visit in (newest, middle):
        with pytest.raises(StoreDamaged, match="cannot be read"):
            people.get(visit.id)
    queue = UploadQueue(store.engine, VirtualClock())
    # building its archive reports the damage
    assert [entry.visit for entry in queue.queued()] == [middle.id, newest.id]


def test_an_unreadable_finish_does_not_block_the_queue(store: CaptureStore) -> None:
    queue = UploadQueue(store.engine, VirtualClock())
    first, second = queue.queued()
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE visits SET finished_at = replace(finished_at, '-', '+') WHERE id = ?", (first.visit,))
    assert [entry.visit for entry in queue.queued(1)] == [second.visit]


def test_a_timestamp_without_a_time_zone_is_damaged(store: CaptureStore) -> None:
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET taken_at = '2026-03-01T12:00:00' WHERE id = 'c0'")
    assert datetime.now(UTC) > min(capture.taken_at for capture in store.captures())
    assert store.damaged() == 1


@pytest.mark.parametrize("value", ["1e3456", "NaN", "-Infinity", "1.5E+999", '"\\ud83d"', '{"a": 1', "[1]"])
def test_a_report_that_cannot_be_written_as_json_again_is_damaged(store: CaptureStore, value: str) -> None:
    report = value if value.startswith(("{", "[")) else f'{{"noise_dn": {value}}}'
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET report = ? WHERE id = 'c1'", (report,))
    assert [capture.id for capture in store.captures()] == ["c2", "c0"]
    assert store.damaged() == 1
