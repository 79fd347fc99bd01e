"""One damaged row is one damaged capture or visit: lists, health's counts and the next start go on without it."""

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
from device.errors import DiffuscopeError, NotKept, StoreDamaged
from device.values import Capture
from services.instrument.visits_api import shown_visit
from services.records.light_book import LightBook
from services.records.outbox import Outbox
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import WHOLE, Store
from services.records.underway import Underway

FILES = dict.fromkeys(sorted(WHOLE), b"content")
REPORT = {
    "method": "variation", "seconds": {"expose": 0.25, "solve": 0.125}, "budget_s": 10.5, "warnings": ["dim"],
    "refraction_dpt": {"sphere": -1.25, "sd": 0.5}, "verdict": {"word": "good", "code": None, "numbers": {"a": 123456}},
    "laterality": {"eye": "OS", "score": 0.5}, "dose_j_per_cm2": 0.0625, "note": "\u00e9",
}  # fmt: skip
TABLES = {
    "captures": ("id", "eye", "taken_at", "calibration_id", "report"), "files": ("capture_id", "name", "sha256"),
    "visits": ("id", "person", "day", "begun_at", "finished_at", "outcome"), "fields": ("visit", "name", "value"),
    "identifiers": ("person", "name", "value"), "shots": ("capture", "visit", "slot"),
    "slots": ("visit", "slot", "capture"), "sendings": ("visit", "finished_at", "failing_since", "error", "said"),
    "persons": ("number",), "light_time": ("boot",), "light_doses": ("eye",), "keys": ("key", "answer", "done_at"),
}  # fmt: skip
TURNS = 4
DISTINCT = 8  # bytes of a text that stands in rows and indices alone, and not in the words that make the tables
COLUMNS = [(table, column) for table, columns in TABLES.items() for column in columns]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with three visits, two of them finished and not sent, and a capture in each."""
    folder, clock = tmp_path_factory.mktemp("filled"), VirtualClock()
    keys = (f"{number:016x}" for number in count())
    with Store(folder, reserve_bytes=0) as store:
        people, light = People(store.engine, load_protocol(), clock), LightBook(store.engine, clock, 86_400.0, "boot")
        for number in range(3):
            visit = people.begin(next(keys)).id
            people.answer(next(keys), visit, "consent", "agreed")
            people.answer(next(keys), visit, "complaints", ["flashes", "red"])
            people.answer(next(keys), visit, "name", f"Name{number}")
            errand = people.errand("OD", next(keys), visit, "R-centre")
            taken = Capture(f"c{number}", "OD", clock.wall(), True, "00ff", errand.facts | REPORT, {})
            store.keep(taken, FILES, errand.beside)
            people.keep(next(keys), f"c{number}")
            if number:
                people.finish(next(keys), visit)
            light.reserve(("OD",), 0.001, 10.0)
            clock.sleep(1)
        Outbox(store.engine, clock).failed(Outbox(store.engine, clock).waiting(), DiffuscopeError("no way"))
    return folder


def copied(filled: Path, to: Path) -> Path:
    to.mkdir()
    for path in sorted(filled.rglob("*")):
        if path.is_dir():
            (to / path.relative_to(filled)).mkdir()
        else:
            (to / path.relative_to(filled)).write_bytes(path.read_bytes())
    return to


def spoil(folder: Path, table: str, column: str, chance: random.Random) -> str:
    """Change one byte of a text of that column: in the row and its indices, or at one of its places in the file."""
    path = folder / "shelf.sqlite"
    with closing(database(folder)) as tables:
        tables.text_factory = bytes
        rows = tables.execute(f"SELECT rowid, {column} FROM {table} WHERE {column} IS NOT NULL").fetchall()
        rowid, content = chance.choice(rows)
        at = chance.randrange(len(content))
        spoilt = bytearray(content)
        spoilt[at] = chance.choice([one for one in range(1, 256) if one != content[at]])
        if len(content) < DISTINCT or chance.random() < 0.5:
            change = f"UPDATE OR IGNORE {table} SET {column} = CAST(? AS TEXT) WHERE rowid = ?"
            tables.execute(change, (bytes(spoilt), rowid))
            return f"row {rowid} of {table}.{column}: {content!r} -> {bytes(spoilt)!r}"
    file = path.read_bytes()
    places = [place.start() for place in re.finditer(re.escape(content), file)]
    place = chance.choice(places)
    path.write_bytes(file[:place] + bytes(spoilt) + file[place + len(spoilt) :])
    return f"{content!r} -> {bytes(spoilt)!r}, {places.index(place) + 1} of {len(places)} in the file"


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_changed_byte_in_any_column_fails_no_list_no_count_and_no_start(
    filled: Path, tmp_path: Path, table: str, column: str
) -> None:
    chance = random.Random(f"{table}.{column}")
    for turn in range(TURNS):
        folder = copied(filled, tmp_path / f"{turn}")
        said = spoil(folder, table, column, chance)
        with Store(folder, reserve_bytes=0) as store:
            everything_is_asked(store, said)


def everything_is_asked(store: Store, said: str) -> None:
    people, clock = People(store.engine, load_protocol(), VirtualClock()), VirtualClock()
    captures, visits = store.captures(2), people.visits(10)
    captures += store.captures(5, before=captures[-1].id)
    if said.startswith("row"):  # of an index alone, what is listed goes by the index, and what is counted by the row
        assert len(captures) + store.damaged() == 3, said
        assert len(visits) + people.damaged() == 3, said
    written = [shown_visit(visit, people) for visit in visits], [capture.report for capture in captures]
    json.dumps(written, allow_nan=False, ensure_ascii=False).encode()
    assert set(people.counts()) == {"done", "to_finish", "referred"}
    people.asked_side()
    outbox = Outbox(store.engine, clock)
    assert outbox.trouble().waiting <= 2
    for waiting in outbox.waiting(sizes=True):
        with suppress(StoreDamaged):
            outbox.failed([waiting], DiffuscopeError("no way"))
    Underway(store)
    assert LightBook(store.engine, clock, 86_400.0).spent_j_per_cm2("OD") >= 0.003 - 1e-9, said
    assert store.space_left() > 0
    assert store.people_left(4) > 0
    for id in ("c0", "c1", "c2"):
        with suppress(StoreDamaged, NotKept):
            store.get(id)
        with suppress(StoreDamaged, NotKept):
            assert store.read(id, "raw.tiff") == b"content"
    assert {path.name for path in (store.folder / "captures").iterdir()} == {"c0", "c1", "c2"}, said


def database(folder: Path) -> sqlite3.Connection:
    tables = sqlite3.connect(folder / "shelf.sqlite", isolation_level=None)
    tables.execute("PRAGMA ignore_check_constraints = ON")
    return tables


@pytest.fixture
def store(filled: Path, tmp_path: Path) -> Iterator[Store]:
    with Store(copied(filled, tmp_path / "own"), reserve_bytes=0) as store:
        yield store


def test_a_damaged_capture_is_refused_alone_and_counted_and_its_files_can_still_be_read(store: Store) -> None:
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET report = replace(report, ':', ';') WHERE id = 'c1'")
    assert [one.id for one in store.captures()] == ["c2", "c0"]
    assert [one.id for one in store.captures(1, before="c2")] == ["c0"]
    assert store.damaged() == 1
    with pytest.raises(StoreDamaged, match="entry of 'c1' cannot be read") as told:
        store.get("c1")
    assert "call the technician" in told.value.remedy.lower()
    assert store.read("c1", "raw.tiff") == b"content"
    people = People(store.engine, load_protocol(), VirtualClock())
    assert [visit.slots["R-centre"].taken[0].capture for visit in people.visits(10)] == ["c2", "c1", "c0"]


def test_a_damaged_visit_is_refused_alone_and_counted(store: Store) -> None:
    people = People(store.engine, load_protocol(), VirtualClock())
    newest, middle, _ = people.visits(10)
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE visits SET outcome = CAST(x'7bff' AS TEXT) WHERE id = ?", (middle.id,))
        tables.execute("UPDATE fields SET value = '[' WHERE visit = ?", (newest.id,))
    assert len(people.visits(10)) == 1
    assert people.damaged() == 2
    for visit in (newest, middle):
        with pytest.raises(StoreDamaged, match="cannot be read"):
            people.get(visit.id)
    outbox = Outbox(store.engine, VirtualClock())
    assert [one.visit for one in outbox.waiting()] == [middle.id, newest.id]  # whoever packs it, hears of the damage


def test_a_finish_that_cannot_be_read_does_not_stand_before_the_others(store: Store) -> None:
    outbox = Outbox(store.engine, VirtualClock())
    first, second = outbox.waiting()
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE visits SET finished_at = replace(finished_at, '-', '+') WHERE id = ?", (first.visit,))
    assert [one.visit for one in outbox.waiting(1)] == [second.visit]


def test_a_moment_is_one_with_a_zone(store: Store) -> None:
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET taken_at = '2026-03-01T12:00:00' WHERE id = 'c0'")
    assert datetime.now(UTC) > min(one.taken_at for one in store.captures())
    assert store.damaged() == 1


@pytest.mark.parametrize("said", ["1e3456", "NaN", "-Infinity", "1.5E+999", '"\\ud83d"', '{"a": 1', "[1]"])
def test_a_report_that_cannot_be_written_as_json_again_is_damaged(store: Store, said: str) -> None:
    report = said if said.startswith(("{", "[")) else f'{{"noise_dn": {said}}}'
    with closing(database(store.folder)) as tables:
        tables.execute("UPDATE captures SET report = ? WHERE id = 'c1'", (report,))
    assert [one.id for one in store.captures()] == ["c2", "c0"]
    assert store.damaged() == 1
