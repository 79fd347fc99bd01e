"""Visit repository: migrations with data, rollback to an earlier release, decisions on slots, idempotency keys."""

import json
import sqlite3
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest
from alembic import command

from device.clock import VirtualClock
from device.errors import SpecError
from services.errors import IdempotencyKeyConflict, RecordNotFound, VisitFinished
from services.records import schema
from services.records.capture import Capture, CaptureReport, PictureVerdict
from services.records.capture_report import read_report
from services.records.capture_store import CaptureStore
from services.records.protocol import DEFAULT_PROTOCOL, load_protocol
from services.records.visit_repository import VisitRepository
from tests.unit.test_migrations import contracted

ID = "20260301T120000-OD-aa"
FILES = {"raw.tiff": b"raw" * 100, "report.json": b"{}"}
# Statements of the earlier release, word for word.
OLD_INSERT = (
    "INSERT INTO captures (id, eye, taken_at, simulated, calibration_id, report) VALUES (?, ?, ?, ?, ?, ?)",
    "INSERT INTO files (capture_id, name, sha256, bytes) VALUES (?, ?, ?, ?)",
)
OLD_SELECT = (
    "SELECT captures.id, captures.eye, captures.taken_at, captures.simulated, captures.calibration_id, captures.report "
    "FROM captures ORDER BY captures.taken_at DESC, captures.id DESC LIMIT 50",
    "SELECT coalesce(sum(files.bytes), 0), count(DISTINCT files.capture_id) FROM files",
)
OLD_LIGHT = (
    "INSERT INTO light_doses (eye, slot, dose_j_per_cm2) VALUES ('OD', 7, 0.5)",
    "UPDATE light_doses SET dose_j_per_cm2 = 0.25 WHERE eye = 'OD' AND slot = 7",
    "DELETE FROM light_doses WHERE eye = 'OD' AND slot = 7",
)
keys = (f"{number:016x}" for number in count(1))


def old_capture(connection: sqlite3.Connection, id: str = ID, folder: Path | None = None) -> None:
    """Store a capture with the statements of an earlier release: files first, then rows."""
    moment = "2026-03-01T12:00:00.000000+00:00"
    connection.execute(OLD_INSERT[0], (id, "OD", moment, 1, "00ff", json.dumps({"method": "x"})))
    for name, content in FILES.items():
        connection.execute(OLD_INSERT[1], (id, name, "0" * 64, len(content)))
        if folder is not None:
            (folder / "captures" / id).mkdir(parents=True, exist_ok=True)
            (folder / "captures" / id / name).write_bytes(content)


def tables(connection: sqlite3.Connection, names: set[str]) -> dict[str, str]:
    rows = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
    return {name: sql for name, sql in rows if name in names}


@pytest.mark.parametrize("release", ["r0001", "r0002"])
def test_tables_of_an_earlier_release_keep_their_data(tmp_path: Path, release: str) -> None:
    engine = schema.open_engine(tmp_path / "shelf.sqlite")
    config = schema.migration_config()
    with schema.for_writing(engine).begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, release)
    engine.dispose()
    with sqlite3.connect(tmp_path / "shelf.sqlite", isolation_level=None) as old:
        old_capture(old, folder=tmp_path)
        names = {name for (name,) in old.execute("SELECT name FROM sqlite_schema")} - {"alembic_version"}
        before = tables(old, names)
        if release == "r0002":
            old.execute(OLD_LIGHT[0])
    old.close()
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert store.newly_quarantined == ()
        kept = store.get(ID)
        assert (kept.eye, kept.report) == ("OD", read_report({"method": "x"}))
        people = VisitRepository(store.engine, load_protocol(), VirtualClock())
        assert people.begin(next(keys)).number == "A00013"
    with sqlite3.connect(tmp_path / "shelf.sqlite") as new:
        assert not [*contracted(before, tables(new, names))]  # expanded only
        doses = new.execute("SELECT dose_j_per_cm2 FROM light_doses").fetchall()
        assert doses == ([(0.5,)] if release == "r0002" else [])
        assert new.execute("PRAGMA foreign_key_check").fetchall() == []
    new.close()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        yield opened


@pytest.fixture
def people(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_protocol(), VirtualClock())


def agreed(people: VisitRepository) -> str:
    """Begin a visit with consent."""
    return people.answer(next(keys), people.begin(next(keys)).id, "consent", "agreed").id


def shoot(store: CaptureStore, people: VisitRepository, visit: str, slot: str, id: str, word: str = "good") -> None:
    target = people.pictures.capture_target("OD", None, visit, slot)
    report = CaptureReport(visit=target.visit, slot=target.slot, verdict=PictureVerdict(word))
    store.save(Capture(id, "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    people.clock.sleep(1)


def test_the_earlier_release_works_on_the_present_tables(store: CaptureStore, people: VisitRepository) -> None:
    """An update may be rolled back after visits were made: the earlier statements still work, and their data stay."""
    visit = people.get(agreed(people))
    shoot(store, people, visit.id, "R-centre", "a")
    with sqlite3.connect(store.folder / "shelf.sqlite", isolation_level=None) as old:
        old.execute("PRAGMA foreign_keys = ON")
        old_capture(old, folder=store.folder)
        assert {row[0] for row in old.execute(OLD_SELECT[0])} == {ID, "a"}
        assert old.execute(OLD_SELECT[1]).fetchone()[1] == 2
        for words in OLD_LIGHT:
            old.execute(words)
    old.close()
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.newly_quarantined == ()
        assert VisitRepository(again.engine, load_protocol(), VirtualClock()).get(visit.id) == people.get(visit.id)
        assert again.get(ID).report == read_report({"method": "x"})


def test_the_best_picture_is_chosen_until_the_user_decides(store: CaptureStore, people: VisitRepository) -> None:
    visit = agreed(people)

    def chosen() -> str | None:
        one = people.get(visit).slots["R-centre"].chosen
        return one.capture if one else None

    shoot(store, people, visit, "R-centre", "poor", "again")
    assert chosen() == "poor"  # a poor picture is better than none
    shoot(store, people, visit, "R-centre", "good")
    shoot(store, people, visit, "R-centre", "poor-2", "again")
    assert chosen() == "good"
    people.pictures.accept_capture(next(keys), "poor")
    assert chosen() == "poor"
    shoot(store, people, visit, "R-centre", "good-2")
    assert chosen() == "good-2"  # better than the chosen one
    people.pictures.choose(next(keys), visit, "R-centre", None)
    assert chosen() is None
    shoot(store, people, visit, "R-centre", "poor-3", "again")
    assert chosen() == "poor-3"  # earlier captures stay unchosen
    people.pictures.mark_not_possible(next(keys), visit, "R-centre", "pupil")
    assert people.get(visit).slots["R-centre"].state == "could_not"
    shoot(store, people, visit, "R-centre", "late")
    assert people.get(visit).slots["R-centre"].state == "taken"


def test_a_capture_requested_before_the_finish_is_stored(store: CaptureStore, people: VisitRepository) -> None:
    visit = agreed(people)
    target = people.pictures.capture_target("OD", None, visit, "R-centre")
    people.finish(next(keys), visit)
    report = CaptureReport(visit=target.visit, slot=target.slot)
    store.save(Capture("late", "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    assert [one.capture for one in people.get(visit).slots["R-centre"].captures] == ["late"]
    ending = people.get(visit).outcome
    assert ending is not None
    assert ending.sentence == "Refer: picture of the left eye not taken."  # the right eye has a picture now
    with pytest.raises(VisitFinished):
        people.pictures.capture_target("OD", None, visit, "R-centre")


def test_a_capture_of_an_unknown_visit_is_not_stored(store: CaptureStore, people: VisitRepository) -> None:
    target = people.pictures.capture_target("OD", None, agreed(people), "R-centre")
    capture = Capture("b", "OD", people.clock.wall(), True, "00ff", CaptureReport(visit="unknown", slot="R-centre"), {})
    with pytest.raises(RecordNotFound):
        store.save(capture, FILES, target.write_rows)
    assert store.captures() == []
    store.close()
    with CaptureStore(store.folder) as again:
        assert again.newly_quarantined == ("b",)


def test_names_are_in_the_table_of_identifiers_only(store: CaptureStore, people: VisitRepository) -> None:
    visit = people.begin(next(keys)).id
    people.answer(next(keys), visit, "name", "Meenakshi")
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        rows = {name: repr(connection.execute(f"SELECT * FROM {name}").fetchall()) for name in names}
    connection.close()
    assert [name for name, held in rows.items() if "Meenakshi" in held] == ["identifiers"]


def test_idempotency_keys_expire_after_a_month(store: CaptureStore, people: VisitRepository) -> None:
    key = next(keys)
    first = people.begin(key)
    people.clock.sleep(31 * 86400)
    people.begin(next(keys))
    assert people.begin(key).id != first.id


def test_an_idempotency_key_belongs_to_one_request(people: VisitRepository) -> None:
    key = next(keys)
    visit = people.begin(key)
    assert people.begin(key) == visit
    for other in (lambda: people.begin(key, "B1"), lambda: people.answer(key, visit.id, "age", 5)):
        with pytest.raises(IdempotencyKeyConflict, match="another request"):
            other()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ('vision_limit = "6/7"', "vision_limit"),
        ('eye = "both"', "eye"),
        ('id = "R-centre"', "same id"),
        ("retakes = -1", "retakes"),
        ('colour = "green"', "not a known key"),
    ],
)
def test_an_invalid_protocol_is_refused_with_the_key_of_the_mistake(tmp_path: Path, change: str, named: str) -> None:
    key = change.split(" ")[0]
    lines = [change if line.startswith(f"{key} ") else line for line in DEFAULT_PROTOCOL.read_text().splitlines()]
    lines = lines if change in lines else [change, *lines]
    (tmp_path / "protocol.toml").write_text("\n".join(lines))
    with pytest.raises(SpecError, match=named):
        load_protocol(tmp_path / "protocol.toml")


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO visits (id, person, day, begun_at) VALUES ('v', 'no one', '2026-01-01', 'x')",
        "INSERT INTO persons (number, made_at) VALUES ('', 'x')",
        "INSERT INTO persons (number, made_at) VALUES ('123456789012345678901', 'x')",
        "UPDATE visits SET finished_at = 'x'",
        "UPDATE visits SET outcome = '{}'",
        "DELETE FROM persons",
        "INSERT INTO fields SELECT id, 'age', 'fifty', 'x' FROM visits",
        "INSERT INTO slots SELECT id, 'R-centre', 'no capture', NULL FROM visits",
        "INSERT INTO keys VALUES ('short', 'a', 'b', 'c')",
        "UPDATE counters SET last = 'many'",
        "INSERT INTO sendings SELECT id, 'x', -1, NULL, NULL, NULL, NULL, NULL, NULL FROM visits",
        "INSERT INTO sendings SELECT id, 'x', 1, NULL, NULL, NULL, 'today', NULL, NULL FROM visits",
        "INSERT INTO sendings VALUES ('no visit', 'x', 1, NULL, NULL, NULL, NULL, NULL, NULL)",
    ],
)
def test_the_constraints_of_the_tables_refuse_invalid_rows(
    store: CaptureStore, people: VisitRepository, statement: str
) -> None:
    people.begin(next(keys))
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        with pytest.raises(sqlite3.IntegrityError):
            connection.execute(statement)
    connection.close()
