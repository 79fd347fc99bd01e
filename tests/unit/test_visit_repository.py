"""Visit repository: numbers, decisions on slots, undo of a finish, idempotency keys, constraints of the tables."""

import sqlite3
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest
from sqlalchemy.orm import Session

from device.clock import VirtualClock
from device.errors import SpecError
from services.errors import IdempotencyKeyConflict, RecordErased, RecordNotFound, VisitFinished
from services.records.capture import Capture, CaptureReport, StoredVerdict
from services.records.capture_store import CaptureStore
from services.records.programme import DEFAULT_PROGRAMME, load_programme
from services.records.schema import VisitRow
from services.records.upload_queue import UploadQueue
from services.records.visit_repository import VisitRepository

FILES = {"raw.tiff": b"raw" * 100, "report.json": b"{}"}
keys = (f"{number:016x}" for number in count(1))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        yield opened


@pytest.fixture
def people(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), VirtualClock())


def agreed(people: VisitRepository) -> str:
    """Begin a visit with consent."""
    return people.answer(next(keys), people.begin(next(keys)).id, "consent", "agreed").id


def shoot(store: CaptureStore, people: VisitRepository, visit: str, slot: str, id: str, word: str = "good") -> None:
    target = people.pictures.capture_target("OD", None, visit, slot)
    report = CaptureReport(visit=target.visit, slot=target.slot, verdict=StoredVerdict(word))
    store.save(Capture(id, "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    people.clock.sleep(1)


def test_the_best_picture_is_chosen_until_the_user_decides(store: CaptureStore, people: VisitRepository) -> None:
    visit = agreed(people)

    def chosen() -> str | None:
        taken = people.get(visit).slots["R-centre"].chosen
        return taken.capture if taken else None

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
    assert people.get(visit).slots["R-centre"].state == "not_possible"
    shoot(store, people, visit, "R-centre", "late")
    assert people.get(visit).slots["R-centre"].state == "taken"


def test_a_capture_requested_before_the_finish_is_stored(store: CaptureStore, people: VisitRepository) -> None:
    visit = agreed(people)
    target = people.pictures.capture_target("OD", None, visit, "R-centre")
    people.finish(next(keys), visit)
    report = CaptureReport(visit=target.visit, slot=target.slot)
    store.save(Capture("late", "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    assert [taken.capture for taken in people.get(visit).slots["R-centre"].captures] == ["late"]
    ending = people.get(visit).outcome
    assert ending is not None
    untaken = [(reason.code, reason.eye, reason.field) for reason in ending.reasons]
    assert untaken == [("not_taken", "OD", "nerve"), ("not_taken", "OS", None)]  # the right eye has a picture now
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
        assert again.newly_quarantined == (), "nothing was written"


PERSON = {"name": "Meenakshisundaram", "phone": "9840012345", "village": "Thiruppullani"}


def test_no_file_of_the_store_holds_what_identifies_a_patient(store: CaptureStore, people: VisitRepository) -> None:
    visit = people.begin(next(keys), "ZQ-77120").id
    for name, value in (PERSON | {"consent": "agreed"}).items():
        people.answer(next(keys), visit, name, value)
    people.answer(next(keys), visit, "name", "Meenakshisundari")
    shoot(store, people, visit, "R-centre", "a")
    people.finish(next(keys), visit)
    store.write_ahead_log.checkpoint_if_possible()
    texts = ["ZQ-77120", "Meenakshisund", *PERSON.values()]
    found = {
        (str(path.relative_to(store.folder)), text)
        for path in store.folder.rglob("*")
        if path.is_file()
        for text in texts
        if text.encode() in path.read_bytes()
    }
    assert found == set()
    shown = people.get(visit)
    assert (shown.number, {name: shown.fields[name] for name in PERSON}) == (
        "ZQ-77120",
        PERSON | {"name": "Meenakshisundari"},
    )
    assert [(change.field, change.was, change.value) for change in people.changes(visit) if change.field in PERSON] == [
        *((name, None, value) for name, value in PERSON.items()),
        ("name", "Meenakshisundaram", "Meenakshisundari"),
    ]


def test_an_erased_patient_is_in_no_list_and_named_as_erased(store: CaptureStore, people: VisitRepository) -> None:
    erased, other = people.begin(next(keys), "ZQ-1").id, people.begin(next(keys), "ZQ-2").id
    people.finish(next(keys), erased)
    with Session(store.engine) as session:
        store.keys.erase(session.get_one(VisitRow, erased).patient)
    assert [visit.id for visit in people.visits(10)] == [other]
    assert [entry.visit for entry in UploadQueue(store.engine, people.clock).queued()] == []
    with pytest.raises(RecordErased):
        people.get(erased)
    with pytest.raises(RecordErased):
        people.changes(erased)


def test_the_search_by_number_follows_changes_of_another_process(store: CaptureStore, people: VisitRepository) -> None:
    first = people.begin(next(keys), "ZQ-100").id
    assert [visit.id for visit in people.visits(10, number="q-1")] == [first]
    with CaptureStore(store.folder, reserve_bytes=0) as other:
        second = VisitRepository(other.engine, people.programme, people.clock).begin(next(keys), "ZQ-101").id
        again = VisitRepository(other.engine, people.programme, people.clock).begin(next(keys), "ZQ-100").id
    assert [visit.id for visit in people.visits(10, number="q-1")] == [again, second, first]
    assert [visit.id for visit in people.visits(10, number="01")] == [second]
    assert people.visits(10, number="5") == []


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
        ("version = 2", "version"),
        ('colour = "green"', "not a known key"),
    ],
)
def test_an_invalid_protocol_is_refused_with_the_key_of_the_mistake(tmp_path: Path, change: str, named: str) -> None:
    key = change.split(" ")[0]
    lines = [change if line.startswith(f"{key} ") else line for line in DEFAULT_PROGRAMME.read_text().splitlines()]
    lines = lines if change in lines else [change, *lines]
    (tmp_path / "programme.toml").write_text("\n".join(lines))
    with pytest.raises(SpecError, match=named):
        load_programme(tmp_path / "programme.toml")


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO visits (id, patient, day, begun_at) VALUES ('v', 'no one', '2026-01-01', 'x')",
        "INSERT INTO patients (made_at, patient_id) VALUES ('x', 'id')",
        "UPDATE patients SET identity = NULL",
        "UPDATE visits SET finished_at = 'x'",
        "UPDATE visits SET outcome = '{}'",
        "DELETE FROM patients",
        "INSERT INTO answers SELECT id, 'age', 'fifty', 'x' FROM visits",
        "INSERT INTO slot_decisions SELECT id, 'R-centre', 'no capture', NULL FROM visits",
        "INSERT INTO idempotency_keys VALUES ('short', 'a', 'b', 'c')",
        "UPDATE counters SET last = 'many'",
        "INSERT INTO uploads SELECT id, 'x', -1, NULL, NULL, NULL, NULL, NULL, NULL FROM visits",
        "INSERT INTO uploads SELECT id, 'x', 1, NULL, NULL, NULL, 'today', NULL, NULL FROM visits",
        "INSERT INTO uploads VALUES ('no visit', 'x', 1, NULL, NULL, NULL, NULL, NULL, NULL)",
    ],
)
def test_the_constraints_of_the_tables_refuse_invalid_rows(
    store: CaptureStore, people: VisitRepository, statement: str
) -> None:
    people.begin(next(keys))
    with sqlite3.connect(store.folder / "store.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        with pytest.raises(sqlite3.IntegrityError):
            connection.execute(statement)
    connection.close()
