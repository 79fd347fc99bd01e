"""Recovery: rows that were lost or damaged are restored from the files of their records at the next opening."""

import json
import random
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import SettingError, StoreError
from services.errors import StoreDamaged
from services.records import schema
from services.records.capture import Capture, CaptureReport, StoredVerdict
from services.records.capture_store import CaptureStore
from services.records.patient_keys import PatientKeys
from services.records.patient_rows import PatientIndex
from services.records.programme import load_programme
from services.records.quarantine import REQUIRED_FILES
from services.records.record_document import RecordDocument, parse_document
from services.records.record_files import CAPTURE_RECORD as RECORD
from services.records.recovery_report import RecoveryReport
from services.records.snapshots import Snapshots
from services.records.visit_repository import VisitRepository
from tests.store_damage import Shown, expected, filled_store, shown

FILES = {name: name.encode() * 50 for name in REQUIRED_FILES}
KEYS = (f"{number:016x}" for number in range(1 << 16))
FLIPS = 20


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        yield opened


def saved(store: CaptureStore, id: str) -> Capture:
    made = CaptureReport(verdict=StoredVerdict("good", numbers={"level": 0.25}), budget_s=2.5)
    return store.save(Capture(id, "OD", VirtualClock().wall(), True, "00ff", made, {}), FILES)


def without_rows(folder: Path, *statements: str) -> None:
    with sqlite3.connect(folder / "store.sqlite", isolation_level=None) as database:
        for statement in statements:
            database.execute(statement)
    database.close()


def flip(path: Path, content: bytes, changed: bytes, nth: int = 0) -> None:
    """Replace the occurrence number `nth` of a text in a file by another of the same length."""
    before = path.read_bytes()
    places = [found.start() for found in re.finditer(re.escape(content), before)]
    place = places[nth]
    path.write_bytes(before[:place] + changed + before[place + len(content) :])


LOST_ROWS = ("DELETE FROM capture_slots", "DELETE FROM files", "DELETE FROM captures")


def test_captures_without_rows_are_adopted_with_all_that_was_stored(store: CaptureStore) -> None:
    kept = [saved(store, id) for id in ("b", "a")]
    store.close()
    without_rows(store.folder, *LOST_ROWS)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.recovery.adopted, again.newly_quarantined) == (["a", "b"], ())
        assert sorted(again.captures(), key=lambda capture: capture.id) == sorted(kept, key=lambda capture: capture.id)
        assert {name: again.read("a", name) for name in FILES} == FILES
        assert again.quarantine.orphans() == []
    with CaptureStore(store.folder, reserve_bytes=0) as once_more:
        assert once_more.recovery == RecoveryReport()


def test_an_adopted_capture_is_in_the_slot_of_its_visit(store: CaptureStore) -> None:
    people = VisitRepository(store.engine, load_programme(), VirtualClock())
    visit = people.answer(next(KEYS), people.begin(next(KEYS)).id, "consent", "agreed").id
    target = people.pictures.capture_target("OD", None, visit, "R-centre")
    report = CaptureReport(visit=visit, slot="R-centre", verdict=StoredVerdict("good"))
    store.save(Capture("a", "OD", people.clock.wall(), True, "00ff", report, {}), FILES, target.write_rows)
    moved = people.pictures.correct_laterality(next(KEYS), "a", "OS", None)
    stored = store.get("a")
    assert stored.eye == "OS"
    store.close()
    without_rows(store.folder, "DELETE FROM slot_decisions", *LOST_ROWS)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.get("a") == stored, "the record holds the correction of the eye"
        slots = VisitRepository(again.engine, load_programme(), VirtualClock()).get(visit).slots
        assert [taken.capture for taken in slots["L-centre"].captures] == ["a"]
        assert slots["L-centre"].captures == moved.slots["L-centre"].captures


def test_an_unreadable_row_is_healed_and_its_neighbours_are_unchanged(store: CaptureStore) -> None:
    kept = [saved(store, id) for id in ("a", "b", "c")]
    store.close()
    flip(store.folder / "store.sqlite", b'"level": 0.25', b'"level": 0.75', nth=1)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (len(again.recovery.healed), again.recovery.rebuilt_because, again.damaged()) == (1, None, 0)
        assert again.captures() == kept[::-1]


def test_an_entry_that_is_no_json_rebuilds_the_database(store: CaptureStore) -> None:
    kept = [saved(store, id) for id in ("a", "b", "c")]
    store.close()
    flip(store.folder / "store.sqlite", b'"level": 0.25', b'"level"; 0.25', nth=1)
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.recovery.rebuilt_because == "CHECK constraint failed in captures"
        assert sorted(again.captures(), key=lambda capture: capture.id) == kept
    assert (store.folder / "damaged" / "1" / "store.sqlite").exists()


@pytest.mark.parametrize("name", [RECORD, "raw.tiff"])
def test_a_flipped_bit_in_a_folder_without_a_row_is_never_shown(store: CaptureStore, name: str) -> None:
    """A changed record is not adopted, unless it reads the same; a changed file is refused when it is read."""
    kept = saved(store, "a")
    store.close()
    random_source = random.Random(20)
    adopted = 0
    for turn in range(FLIPS):
        folder = shutil.copytree(store.folder, store.folder.with_name(f"{turn}"))
        without_rows(folder, *LOST_ROWS)
        place = folder / "captures" / "a" / name
        content = bytearray(place.read_bytes())
        content[random_source.randrange(len(content))] ^= 1 << random_source.randrange(8)
        place.write_bytes(content)
        with CaptureStore(folder, reserve_bytes=0) as again:
            assert again.captures() in ([], [kept]), turn
            adopted += len(again.recovery.adopted)
            assert len(again.recovery.adopted) + len(again.quarantine.orphans()) == 1, turn
            if name != RECORD:
                with pytest.raises(StoreDamaged, match="cannot be decrypted"):
                    again.read("a", name)
    assert adopted < FLIPS if name == RECORD else adopted == FLIPS


def test_a_database_that_takes_no_rows_does_not_prevent_the_start(store: CaptureStore) -> None:
    kept = saved(store, "a")
    store.close()
    refuse = "CREATE TRIGGER full BEFORE INSERT ON captures BEGIN SELECT RAISE(FAIL, 'no space'); END"
    without_rows(store.folder, *LOST_ROWS, refuse)
    with closing(sqlite3.connect(store.folder / "store.sqlite", isolation_level=None)) as tables:
        (before,) = tables.execute("PRAGMA user_version").fetchone()
        checksum = schema.schema_checksum(tables.execute(schema.SCHEMA_TEXT).fetchall())
        tables.execute(f"PRAGMA user_version = {checksum}")
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.recovery.adopted, again.quarantine.orphans()) == ([], ["a"])
    without_rows(store.folder, "DROP TRIGGER full", f"PRAGMA user_version = {before}")
    with CaptureStore(store.folder, reserve_bytes=0) as once_more:
        assert (once_more.recovery.adopted, once_more.captures()) == (["a"], [kept])


def test_a_record_of_another_capture_or_format_is_refused(store: CaptureStore) -> None:
    saved(store, "a")
    store.close()
    without_rows(store.folder, *LOST_ROWS)
    captures = store.folder / "captures"
    shutil.copytree(captures / "a", captures / "b")
    record = json.loads((captures / "a" / RECORD).read_bytes())
    (captures / "a" / RECORD).write_text(json.dumps(record | {"format": 3}))
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert (again.recovery.adopted, again.quarantine.orphans()) == ([], ["a", "b"])


def test_a_file_cannot_take_the_place_of_the_record(store: CaptureStore) -> None:
    with pytest.raises(SettingError, match="written by the store"):
        store.save(Capture("a", "OD", VirtualClock().wall(), True, "00ff", CaptureReport(), {}), {RECORD: b"{}"})


# Visits and patients


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Shown]:
    """Return a store with visits, captures and doses, and what it shows."""
    store = filled_store(tmp_path_factory.mktemp("filled"), with_log=False)
    return store, expected(store)


def test_the_files_of_a_store_alone_rebuild_all_that_it_shows(filled: tuple[Path, Shown], tmp_path: Path) -> None:
    folder, before = shutil.copytree(filled[0], tmp_path / "copy"), filled[1]
    (folder / "store.sqlite").unlink()
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert store.recovery.rebuilt_because == "it is missing or empty"
        assert (len(store.recovery.adopted), len(store.recovery.visits)) == (len(before.captures), len(before.visits))
    assert shown(folder) == (before, 0)
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert store.recovery == RecoveryReport()


@pytest.mark.parametrize("is_gone", [True, False], ids=["gone", "damaged"])
def test_a_visit_that_is_lost_with_the_database_is_reported(
    filled: tuple[Path, Shown], tmp_path: Path, is_gone: bool
) -> None:
    """Two faults at once. The pictures of the visit are listed, and name it."""
    folder, before = shutil.copytree(filled[0], tmp_path / "copy"), filled[1]
    (folder / "store.sqlite").unlink()
    file = sorted((folder / "visits").iterdir())[0]
    if is_gone:
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:-20])
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert store.recovery.lost_visits == [file.stem]
        assert len(store.captures(100)) == len(before.captures)


def test_an_older_database_does_not_undo_later_changes(tmp_path: Path) -> None:
    folder, clock = tmp_path / "store", VirtualClock()
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.begin(next(KEYS)).id
        people.answer(next(KEYS), visit, "age", 40)
        people.answer(next(KEYS), visit, "name", "Asha")
    older = (folder / "store.sqlite").read_bytes()
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        people.answer(next(KEYS), visit, "age", 41)
        people.answer(next(KEYS), visit, "name", "Usha")
        people.finish(next(KEYS), visit)
        latest = people.get(visit), people.get(people.begin(next(KEYS)).id)
    (folder / "store.sqlite").write_bytes(older)
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        assert tuple(people.get(stored_visit.id) for stored_visit in latest) == latest
        assert sorted(store.recovery.visits) == sorted(stored_visit.id for stored_visit in latest)
        assert store.recovery.conflicts == []


def test_repeated_requests_have_no_further_effect_after_a_rebuild(tmp_path: Path) -> None:
    folder, clock = tmp_path / "store", VirtualClock()
    begin, press = next(KEYS), next(KEYS)
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.begin(begin).id
        people.answer(next(KEYS), visit, "consent", "agreed")
        target = people.pictures.capture_target("OD", press, visit, "R-centre")
        report = CaptureReport(visit=visit, slot="R-centre", verdict=StoredVerdict("good"))
        taken = Capture("a", "OD", clock.wall(), True, "00ff", report, {})
        store.save(taken, FILES, target.write_rows, target.request)
    (folder / "store.sqlite").unlink()
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        assert people.begin(begin).id == visit
        assert people.pictures.capture_for_key(press, "OD", visit, "R-centre") == "a"


def test_a_change_that_was_killed_between_file_and_commit_is_applied_as_a_whole(tmp_path: Path) -> None:
    folder, clock = tmp_path / "store", VirtualClock()
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.begin(next(KEYS)).id
        people.answer(next(KEYS), visit, "age", 40)
    older = (folder / "store.sqlite").read_bytes()
    with CaptureStore(folder, reserve_bytes=0) as store:
        changed = VisitRepository(store.engine, load_programme(), clock).finish(next(KEYS), visit)
    (folder / "store.sqlite").write_bytes(older)
    for _ in range(2):
        with CaptureStore(folder, reserve_bytes=0) as store:
            assert VisitRepository(store.engine, load_programme(), clock).get(visit) == changed


def test_a_change_that_the_database_refuses_leaves_the_files_as_they_were(tmp_path: Path) -> None:
    folder, clock = tmp_path / "store", VirtualClock()
    with CaptureStore(folder, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.begin(next(KEYS)).id
        before = files_of(folder)
        without_rows(
            folder, "CREATE TRIGGER full BEFORE INSERT ON idempotency_keys BEGIN SELECT RAISE(FAIL, 'no space'); END"
        )
        for act in (lambda: people.answer(next(KEYS), visit, "age", 40), lambda: people.begin(next(KEYS))):
            with pytest.raises(StoreError):
                act()
        assert files_of(folder) == before


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for name in ("visits", "patients") for path in (folder / name).iterdir()}


LATER, EARLIER = "2026-03-01T18:00:00+00:00", "2026-03-01T12:30:00+00:00"


@pytest.mark.parametrize(("age", "set_at", "used", "other"), [(70, LATER, 70, 60), (51, EARLIER, 60, 51)])
def test_after_older_tables_were_changed_the_later_change_is_used_and_the_other_stored(
    tmp_path: Path, age: int, set_at: str, used: int, other: int
) -> None:
    clock = VirtualClock(start=datetime(2026, 3, 1, 12, tzinfo=UTC))
    snapshots = Snapshots(tmp_path / "store.sqlite", clock)
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.answer(next(KEYS), people.begin(next(KEYS)).id, "age", 50).id
        saved(store, "old")
        snapshots.create("s0001")
        clock.sleep(3600)
        people.answer(next(KEYS), visit, "age", 60)
        saved(store, "new")
    snapshots.restore(snapshots.names()[0])
    without_rows(tmp_path, f"UPDATE answers SET value = '{age}', set_at = '{set_at}' WHERE name = 'age'")
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        assert {capture.id for capture in store.captures()} == {"old", "new"}
        assert {name: store.read("new", name) for name in FILES} == FILES
        assert people.get(visit).fields["age"] == used
        stored = [json.loads(path.read_bytes())["record"] for path in (tmp_path / "conflicts").glob(f"visit-{visit}-*")]
        assert [record["answers"]["age"]["value"] for record in stored] == [other]
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert store.recovery == RecoveryReport()


@pytest.mark.parametrize(("number", "other"), [("X1", "X1-2"), ("A" * 20, "A" * 18 + "-2")])
def test_a_number_that_was_given_again_in_older_tables_mixes_up_no_patients(
    tmp_path: Path, number: str, other: str
) -> None:
    clock = VirtualClock(start=datetime(2026, 3, 1, 13, tzinfo=UTC))
    snapshots = Snapshots(tmp_path / "store.sqlite", clock)
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        snapshots.create("s0001")
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.begin(next(KEYS), number).id
        people.answer(next(KEYS), visit, "name", "Asha")
        people.answer(next(KEYS), visit, "age", 30)
    snapshots.restore(snapshots.names()[0])
    now = "'2026-03-01T18:00:00.000000+00:00'"
    usha, index = "0" * 16, PatientIndex(PatientKeys(tmp_path, None))
    index.keys.create(usha)
    identity = index.encrypted(usha, {"number": number, "name": "Usha"})
    without_rows(  # the number is given to another patient
        tmp_path,
        f"INSERT INTO patients (patient_id, made_at, identity) VALUES ('{usha}', {now}, '{identity}')",
        f"INSERT INTO visits (id, patient, day, begun_at) VALUES ('v1', '{usha}', '2026-03-01', {now})",
        f"INSERT INTO answers (visit, name, value, set_at) VALUES ('v1', 'age', '51', {now})",
    )
    for _ in range(2):
        with CaptureStore(tmp_path, reserve_bytes=0) as store:
            people = VisitRepository(store.engine, load_programme(), clock)
            found = {
                stored_visit.id: (stored_visit.number, stored_visit.fields["name"], stored_visit.fields["age"])
                for stored_visit in people.visits(10)
            }
            assert found == {"v1": (number, "Usha", 51), visit: (other, "Asha", 30)}
    in_files = [index.identity(document.id, document.content["identity"]) for document in documents(tmp_path)]
    assert sorted(in_files) == sorted([(number, {"name": "Usha"}), (other, {"name": "Asha"})])


def documents(folder: Path) -> list[RecordDocument]:
    return [parse_document(path.read_bytes()) for path in (folder / "patients").iterdir()]


def test_a_damaged_id_of_a_patient_is_restored(store: CaptureStore) -> None:
    people = VisitRepository(store.engine, load_programme(), VirtualClock())
    people.answer(next(KEYS), people.begin(next(KEYS)).id, "name", "Asha")
    before = people.visits(10)
    store.close()
    id = documents(store.folder)[0].id
    changed = ("f" if id[0] != "f" else "e") + id[1:]
    flip(store.folder / "store.sqlite", id.encode(), changed.encode())
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert VisitRepository(again.engine, load_programme(), VirtualClock()).visits(10) == before
    assert [document.id for document in documents(store.folder)] == [id]


def test_a_changed_definition_of_a_table_rebuilds_the_database(store: CaptureStore) -> None:
    """SQLite's integrity check passes, because the definition is valid."""
    kept = saved(store, "a")
    store.close()
    flip(store.folder / "store.sqlite", b"length(value) <= 2000", b"length(value) <= 3000")
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.recovery.rebuilt_because == "the definitions of its tables are not those that were written"
        assert again.captures() == [kept]
