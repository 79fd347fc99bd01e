"""Persons and visits on the shelf: migrations with data in them, the release before on the new tables, kept answers."""

import json
import sqlite3
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest
from alembic import command

from device.clock import VirtualClock
from device.errors import InputError, NotKept, SpecError, VisitFinished
from device.values import Capture
from services.records import schema
from services.records.people import People
from services.records.protocol import STANDARD, load_protocol
from services.records.store import Store

ID = "20260301T120000-OD-aa"
FILES = {"raw.tiff": b"raw" * 100, "report.json": b"{}"}
# What the release before says to its database, word for word.
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
    """Keep a capture as the release before did: files first, then rows."""
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
def test_a_shelf_of_an_earlier_release_keeps_all_it_had(tmp_path: Path, release: str) -> None:
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
    with Store(tmp_path, reserve_bytes=0) as store:
        assert store.swept == ()
        kept = store.get(ID)
        assert (kept.eye, kept.report) == ("OD", {"method": "x"})
        people = People(store.engine, load_protocol(), VirtualClock())
        assert people.begin(next(keys)).number == "A00013"
    with sqlite3.connect(tmp_path / "shelf.sqlite") as new:
        assert tables(new, names) == before  # expanded, and nothing that was there is different
        doses = new.execute("SELECT dose_j_per_cm2 FROM light_doses").fetchall()
        assert doses == ([(0.5,)] if release == "r0002" else [])
        assert new.execute("PRAGMA foreign_key_check").fetchall() == []
    new.close()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "shelf", reserve_bytes=0) as opened:
        yield opened


@pytest.fixture
def people(store: Store) -> People:
    return People(store.engine, load_protocol(), VirtualClock())


def agreed(people: People) -> str:
    """A new visit whose person agreed to pictures."""
    return people.answer(next(keys), people.begin(next(keys)).id, "consent", "agreed").id


def shoot(store: Store, people: People, visit: str, slot: str, id: str, word: str = "good") -> None:
    errand = people.errand("OD", None, visit, slot)
    verdict = {"verdict": {"word": word, "code": None, "numbers": {}}}
    store.keep(Capture(id, "OD", people.clock.wall(), True, "00ff", errand.facts | verdict, {}), FILES, errand.beside)
    people.clock.sleep(1)


def test_the_release_before_works_on_these_tables(store: Store, people: People) -> None:
    """An update may be rolled back after people were seen: the old words still work, and nothing of theirs is lost."""
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
    with Store(store.folder, reserve_bytes=0) as again:
        assert again.swept == ()
        assert People(again.engine, load_protocol(), VirtualClock()).get(visit.id) == people.get(visit.id)
        assert again.get(ID).report == {"method": "x"}


def test_the_best_picture_stands_for_a_slot_until_somebody_chooses(store: Store, people: People) -> None:
    visit = agreed(people)

    def chosen() -> str | None:
        one = people.get(visit).slots["R-centre"].chosen
        return one.capture if one else None

    shoot(store, people, visit, "R-centre", "poor", "again")
    assert chosen() == "poor"  # never an empty box
    shoot(store, people, visit, "R-centre", "good")
    shoot(store, people, visit, "R-centre", "poor-2", "again")
    assert chosen() == "good"
    people.keep(next(keys), "poor")
    assert chosen() == "poor"
    shoot(store, people, visit, "R-centre", "good-2")
    assert chosen() == "good-2"  # better than what was chosen
    people.choose(next(keys), visit, "R-centre", None)
    assert chosen() is None
    shoot(store, people, visit, "R-centre", "poor-3", "again")
    assert chosen() == "poor-3"  # what was put aside stays aside
    people.could_not(next(keys), visit, "R-centre", "pupil")
    assert people.get(visit).slots["R-centre"].state == "could_not"
    shoot(store, people, visit, "R-centre", "late")
    assert people.get(visit).slots["R-centre"].state == "taken"


def test_a_picture_that_was_pressed_before_the_finish_is_not_lost(store: Store, people: People) -> None:
    visit = agreed(people)
    errand = people.errand("OD", None, visit, "R-centre")
    people.finish(next(keys), visit)
    report = errand.facts | {"verdict": None}
    store.keep(Capture("late", "OD", people.clock.wall(), True, "00ff", report, {}), FILES, errand.beside)
    assert [one.capture for one in people.get(visit).slots["R-centre"].taken] == ["late"]
    ending = people.get(visit).outcome
    assert ending is not None
    assert ending.sentence == "Refer: picture of the left eye not taken."  # of the right one there is one now
    with pytest.raises(VisitFinished):
        people.errand("OD", None, visit, "R-centre")


def test_a_picture_whose_visit_is_unknown_is_not_half_kept(store: Store, people: People) -> None:
    errand = people.errand("OD", None, agreed(people), "R-centre")
    capture = Capture("b", "OD", people.clock.wall(), True, "00ff", {"visit": "nobody", "slot": "R-centre"}, {})
    with pytest.raises(NotKept):
        store.keep(capture, FILES, errand.beside)
    assert store.captures() == []
    store.close()
    with Store(store.folder) as again:
        assert again.swept == ("b",)


def test_names_stand_apart_from_pictures_and_keys_remember_nothing_readable(store: Store, people: People) -> None:
    visit = people.begin(next(keys)).id
    people.answer(next(keys), visit, "name", "Meenakshi")
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        rows = {name: repr(connection.execute(f"SELECT * FROM {name}").fetchall()) for name in names}
    connection.close()
    assert [name for name, held in rows.items() if "Meenakshi" in held] == ["identifiers"]


def test_old_keys_are_forgotten_after_a_month(store: Store, people: People) -> None:
    key = next(keys)
    first = people.begin(key)
    people.clock.sleep(31 * 86400)
    people.begin(next(keys))
    assert people.begin(key).id != first.id


def test_a_key_belongs_to_one_request(people: People) -> None:
    key = next(keys)
    visit = people.begin(key)
    assert people.begin(key) == visit
    for other in (lambda: people.begin(key, "B1"), lambda: people.answer(key, visit.id, "age", 5)):
        with pytest.raises(InputError, match="another request"):
            other()


@pytest.mark.parametrize(
    ("change", "said"),
    [('vision_limit = "6/7"', "vision_limit"), ('eye = "both"', "eye"), ('id = "R-centre"', "same id"),
     ("retakes = -1", "retakes"), ('colour = "green"', "not a known key")],
)  # fmt: skip
def test_a_protocol_with_a_mistake_names_it(tmp_path: Path, change: str, said: str) -> None:
    key = change.split(" ")[0]
    lines = [change if line.startswith(f"{key} ") else line for line in STANDARD.read_text().splitlines()]
    lines = lines if change in lines else [change, *lines]
    (tmp_path / "protocol.toml").write_text("\n".join(lines))
    with pytest.raises(SpecError, match=said):
        load_protocol(tmp_path / "protocol.toml")


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO visits VALUES ('v', 'nobody', '2026-01-01', 'x', NULL, NULL, NULL)",
        "INSERT INTO persons VALUES ('', 'x')", "INSERT INTO persons VALUES ('123456789012345678901', 'x')",
        "UPDATE visits SET finished_at = 'x'", "UPDATE visits SET outcome = '{}'", "DELETE FROM persons",
        "INSERT INTO fields SELECT id, 'age', 'fifty', 'x' FROM visits",
        "INSERT INTO slots SELECT id, 'R-centre', 'no capture', NULL FROM visits",
        "INSERT INTO keys VALUES ('short', 'a', 'b', 'c')", "UPDATE counters SET last = 'many'",
        "INSERT INTO sendings SELECT id, 'x', -1, NULL, NULL, NULL, NULL, NULL, NULL FROM visits",
        "INSERT INTO sendings SELECT id, 'x', 1, NULL, NULL, NULL, 'today', NULL, NULL FROM visits",
        "INSERT INTO sendings VALUES ('no visit', 'x', 1, NULL, NULL, NULL, NULL, NULL, NULL)",
    ],
)  # fmt: skip
def test_the_tables_themselves_refuse_nonsense(store: Store, people: People, statement: str) -> None:
    people.begin(next(keys))
    with sqlite3.connect(store.folder / "shelf.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        with pytest.raises(sqlite3.IntegrityError):
            connection.execute(statement)
    connection.close()
