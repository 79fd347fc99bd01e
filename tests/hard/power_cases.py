"""Cases of power cuts: preparation, action, and the invariants of whatever remains.

Run as a module, this file is the victim process: it runs one action after another and acknowledges each.
"""

import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from device import atomic_io
from device.calibration.archive import Archive
from device.clock import SystemClock, VirtualClock
from device.errors import CalibrationMissing
from services.errors import RecordRemoved
from services.records import schema
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.recovery import rebuild_database
from services.records.recovery_report import RecoveryReport
from services.records.removed_captures import Removal
from services.records.snapshots import Snapshots
from services.records.visit_repository import VisitRepository
from tests.hard.power_backup import back_up, judge_backup, judge_restored, restore, with_backup, with_new_device
from tests.hard.power_fat import (
    FILES,
    commit,
    commit_by_rename,
    export,
    judge_choice,
    judge_export,
    judge_rename,
    with_choice,
    with_stick,
)
from tests.second_migration import FIRST, SECOND, migrate, with_second_migration
from tests.unit.test_archive import WHO, calibration

OLD, NEW = (replace(calibration(black_dn), dark_dn=None, bad=None) for black_dn in (64.25, 65.0))
ADOPTED = "adopted"


def capture(name: str, second: int = 0) -> Capture:
    taken_at = datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=second)
    return Capture(name, "OS", taken_at, False, "00ff", CaptureReport("wiener"), {})


def people(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), SystemClock())


# A case: preparation, action and judgement; `acknowledged` holds the steps that the action reported as done.

Prepare = Callable[[Path], None]
Act = Callable[[Path, Callable[[str], None]], None]
Judge = Callable[[Path, list[str]], str]


@dataclass(frozen=True)
class Case:
    prepare: Prepare
    act: Act
    judge: Judge
    outcomes: frozenset[str]
    fat: tuple[str, ...] = ()  # folders on FAT


def store_with_one(folder: Path) -> None:
    with CaptureStore(folder, reserve_bytes=0) as store:
        store.save(capture("before"), FILES)


def store_with_ledger(folder: Path) -> None:
    """A device that was used has a ledger; without one both eyes count as full."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        DoseLedgerStore(store.engine, VirtualClock(), 86_400.0, boot="boot")
    store_with_one(folder)


def keep(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with CaptureStore(folder, reserve_bytes=0) as store:
        for number in (1, 2):
            store.save(capture(f"new{number}", number), FILES)
            acknowledge(f"new{number}")


def judge_kept(folder: Path, acknowledged: list[str]) -> str:
    with CaptureStore(folder, reserve_bytes=0) as store:
        listed = {record.id for record in store.captures()}
        assert {*acknowledged, *(["before"] if (folder / "captures" / "before").exists() else [])} <= listed
        for id in listed:
            assert {name: store.read(id, name) for name in store.get(id).files} == FILES
        assert {path.name for path in (folder / "captures").iterdir()} == listed
        return "new" if "new1" in listed else "torn" if store.newly_quarantined else "old"


def judge_kept_beside(folder: Path, acknowledged: list[str]) -> str:
    assert (folder / "captures" / "before").is_dir()
    return judge_kept(folder, acknowledged)


def answer(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with CaptureStore(folder, reserve_bytes=0) as store:
        repository, keys = people(store), (f"{number:016x}" for number in count())
        visit = repository.begin(next(keys)).id
        for age in range(1, 6):
            repository.answer(next(keys), visit, "age", age)
            acknowledge(str(age))
        repository.finish(next(keys), visit)
        acknowledge("6")


def judge_answers(folder: Path, acknowledged: list[str]) -> str:
    with CaptureStore(folder, reserve_bytes=0) as store:
        visits, last = people(store).visits(10), int(acknowledged[-1]) if acknowledged else 0
        if not visits:
            assert not acknowledged
            return "old"
        reached = 6 if visits[0].finished_at else visits[0].fields.get("age", 0)
        assert reached in (last, last + 1)
        return "new"


def reserve_dose(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with CaptureStore(folder, reserve_bytes=0) as store:
        ledger = DoseLedgerStore(store.engine, VirtualClock(), 86_400.0, boot="boot")
        ledger.reserve(("OD",), 1.0, 10.0)
        acknowledge("reserved")


def judge_light(folder: Path, acknowledged: list[str]) -> str:
    with CaptureStore(folder, reserve_bytes=0) as store:
        spent = DoseLedgerStore(store.engine, VirtualClock(), 86_400.0, boot="boot").spent_j_per_cm2("OD")
        assert spent == 1.0 or not acknowledged
        return "new" if spent else "old"


def calibrated(folder: Path) -> None:
    (folder / "calibrations").mkdir()
    Archive(folder / "calibrations" / "head").add_and_activate(OLD, WHO)


def recalibrate(folder: Path, acknowledge: Callable[[str], None]) -> None:
    archive = Archive(folder / "calibrations" / "head")
    archive.add_and_activate(NEW, WHO)
    acknowledge(NEW.id)
    archive.activate(OLD.id)
    acknowledge(OLD.id)


def import_calibration(folder: Path, acknowledge: Callable[[str], None]) -> None:
    """Import a calibration that another archive exported."""
    archive = Archive(folder / "calibrations" / "head")
    archive.add_files(Archive(folder / "elsewhere").files(NEW.id))
    acknowledge(ADOPTED)


def with_exported_calibration(folder: Path) -> None:
    calibrated(folder)
    Archive(folder / "elsewhere").add(NEW, WHO)


def first_calibration(folder: Path, acknowledge: Callable[[str], None]) -> None:
    Archive(folder / "calibrations" / "head").add_and_activate(NEW, WHO)
    acknowledge(NEW.id)


def judge_calibration(folder: Path, acknowledged: list[str]) -> str:
    archive = Archive(folder / "calibrations" / "head")
    kept = {archive.load(id).calibration.id for id in archive.ids()}
    try:
        in_force = archive.load().calibration.id
    except CalibrationMissing:
        assert not acknowledged
        return "none"
    if acknowledged == [ADOPTED]:
        assert NEW.id in kept
    elif acknowledged and not (acknowledged == [NEW.id] and in_force == OLD.id and OLD.id in kept):
        assert in_force == acknowledged[-1]
    return "new" if NEW.id in kept else "old"


def with_captures(folder: Path, *names: str) -> None:
    for second, name in enumerate(names):
        with CaptureStore(folder / "data", reserve_bytes=0) as store:
            store.save(capture(name, second), FILES)


def in_tables(folder: Path) -> list[str] | None:
    """Return the ids of the captures in the tables before any recovery; None without a database."""
    database = folder / "data" / schema.DATABASE
    if not database.exists():
        return None
    with closing(sqlite3.connect(database)) as tables:
        return [id for (id,) in tables.execute("SELECT id FROM captures ORDER BY rowid")]


def with_first_tables(folder: Path) -> None:
    with_captures(folder, "c1")


def migrate_tables(folder: Path, acknowledge: Callable[[str], None]) -> None:
    """Migrate as a later release with a made-up migration does."""
    with TemporaryDirectory() as place:
        migrate(folder / "data", with_second_migration(Path(place)), SystemClock())
    acknowledge("open")


def judge_migration(folder: Path, acknowledged: list[str]) -> str:
    """This release works on the tables at any time; each snapshot is complete; the later release ends its migration."""
    data = folder / "data"
    for path in data.glob("snapshots/*.db"):
        with closing(sqlite3.connect(path)) as tables:
            assert tables.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            assert tables.execute("SELECT version_num FROM alembic_version").fetchone() == (FIRST,)
            assert tables.execute("SELECT id FROM captures").fetchall() == [("c1",)]
    with closing(sqlite3.connect(data / schema.DATABASE)) as tables:
        (version,) = tables.execute("SELECT version_num FROM alembic_version").fetchone()
    assert version == FIRST or list(data.glob("snapshots/*.db")), "changed without a snapshot"
    assert version == SECOND or not acknowledged
    for _ in range(2):
        with CaptureStore(data, reserve_bytes=0) as store:
            assert (store.recovery, [record.id for record in store.captures()]) == (RecoveryReport(), ["c1"])
            assert {name: store.read("c1", name) for name in FILES} == FILES
        migrate_tables(folder, lambda word: None)
        assert len(list(data.glob("snapshots/*.db"))) == 1
    return "old" if version == FIRST else "new"


def with_damaged_database(folder: Path) -> None:
    store_with_one(folder)
    (folder / "store.sqlite").write_bytes(b"damaged" * 1000)


def rebuild(folder: Path, acknowledge: Callable[[str], None]) -> None:
    rebuild_database(folder)
    with CaptureStore(folder, reserve_bytes=0):
        acknowledge("before")


def judge_rebuilt(folder: Path, acknowledged: list[str]) -> str:
    """The capture is there at any time, and the damaged database stays."""
    outcome = judge_kept_beside(folder, acknowledged or ["before"])
    damaged = [path.read_bytes() for path in folder.glob("damaged/*/store.sqlite")]
    assert b"damaged" * 1000 in damaged
    return outcome


def remove_and_undo(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with CaptureStore(folder, reserve_bytes=0) as store:
        store.removed.remove(["before"], Removal("sent", datetime(2026, 3, 1, tzinfo=UTC)))
        acknowledge("removed")
        store.removed.undo()
        acknowledge("back")


def judge_removed(folder: Path, acknowledged: list[str]) -> str:
    """Each file is there or known as removed, and all come back."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert [record.id for record in store.captures()] == ["before"]
        missing = set[str]()
        for name, content in FILES.items():
            try:
                assert store.read("before", name) == content
            except RecordRemoved:
                missing.add(name)
        assert not missing or acknowledged != ["removed", "back"]
        store.removed.undo()
        assert {name: store.read("before", name) for name in FILES} == FILES
    return "removed" if missing else "whole"


def half_kept(folder: Path) -> None:
    store_with_one(folder)
    (folder / "captures" / ".half.part").mkdir()
    (folder / "captures" / ".half.part" / "raw.tiff").write_bytes(FILES["raw.tiff"])


def judge_swept(folder: Path, acknowledged: list[str]) -> str:
    before = {path.name for path in (folder / "quarantine").iterdir()}
    with CaptureStore(folder, reserve_bytes=0) as store:
        kept = [path.read_bytes() for path in (folder / "quarantine").glob("half*/raw.tiff")]
        assert kept
        assert set(kept) == {FILES["raw.tiff"]}
        assert [record.id for record in store.captures()] == ["before"]
    return "new" if before else "old"


def with_snapshot(folder: Path) -> None:
    with_captures(folder, "c1")
    snapshots(folder).create(FIRST)
    with_captures(folder, "c2")


def snapshots(folder: Path) -> Snapshots:
    return Snapshots(folder / "data" / schema.DATABASE, VirtualClock())


def restore_snapshot(folder: Path, acknowledge: Callable[[str], None]) -> None:
    snapshots(folder).restore(snapshots(folder).names()[0])
    acknowledge("back")


def judge_restored_snapshot(folder: Path, acknowledged: list[str]) -> str:
    """The tables are the present or the restored ones, or gone in between; the next opening shows all captures."""
    found = in_tables(folder)
    assert found == ["c1"] or not acknowledged
    with CaptureStore(folder / "data", reserve_bytes=0) as store:
        assert {record.id for record in store.captures()} == {"c1", "c2"}
        assert [store.read(id, name) for id in ("c1", "c2") for name in FILES] == [*FILES.values()] * 2
    return "gone" if found is None else "new" if found == ["c1"] else "old"


# Negative controls: programs without fsync, whose losses the simulation must detect.


def with_note(folder: Path) -> None:
    (folder / "note").write_bytes(b"old")


def does_not_wait(folder: Path, acknowledge: Callable[[str], None]) -> None:
    (folder / "part").write_bytes(b"new")
    (folder / "part").rename(folder / "note")
    acknowledge("new")


def waits_for_the_file_alone(folder: Path, acknowledge: Callable[[str], None]) -> None:
    atomic_io.write_file(folder / "part", b"new")
    (folder / "part").rename(folder / "note")
    acknowledge("new")


def judge_note(folder: Path, acknowledged: list[str]) -> str:
    note = (folder / "note").read_bytes().decode()
    return "lost" if acknowledged and note != "new" else note or "empty"


def with_loose_tables(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "loose.sqlite", isolation_level=None)) as tables:
        tables.execute("CREATE TABLE notes (note BLOB)")
        tables.execute("INSERT INTO notes VALUES (zeroblob(60000))")


def trusts_the_disk(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with closing(sqlite3.connect(folder / "loose.sqlite", isolation_level=None)) as tables:
        tables.execute("PRAGMA synchronous = OFF")
        tables.execute("INSERT INTO notes SELECT randomblob(60000)")
        acknowledge("new")


def judge_loose(folder: Path, acknowledged: list[str]) -> str:
    with closing(sqlite3.connect(folder / "loose.sqlite")) as tables:
        try:
            number = len(tables.execute("SELECT hex(note) FROM notes").fetchall())
            whole = tables.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        except sqlite3.DatabaseError:
            return "damaged"
    return "damaged" if not whole else "lost" if acknowledged and number < 2 else "new" if number == 2 else "old"


def nothing(folder: Path) -> None:
    pass


def opened(folder: Path, acknowledge: Callable[[str], None]) -> None:
    with CaptureStore(folder, reserve_bytes=0):
        acknowledge("open")


OLD_NEW = frozenset({"old", "new"})
CASES = {
    "a capture is kept": Case(store_with_one, keep, judge_kept_beside, frozenset({"old", "torn", "new"})),
    "the first capture of a new device": Case(nothing, keep, judge_kept, frozenset({"old", "torn", "new"})),
    "answers of a visit": Case(store_with_one, answer, judge_answers, OLD_NEW),
    "the dose ledger": Case(store_with_ledger, reserve_dose, judge_light, OLD_NEW),
    "a calibration is kept and taken back": Case(calibrated, recalibrate, judge_calibration, OLD_NEW),
    "a calibration is taken in": Case(with_exported_calibration, import_calibration, judge_calibration, OLD_NEW),
    "the first calibration": Case(nothing, first_calibration, judge_calibration, frozenset({"none", "new"})),
    "a slot is committed": Case(with_choice, commit, judge_choice, frozenset("AB"), ("chooser",)),
    "tables are migrated": Case(with_first_tables, migrate_tables, judge_migration, OLD_NEW),
    "a damaged database is rebuilt": Case(with_damaged_database, rebuild, judge_rebuilt, frozenset({"old"})),
    "pictures are removed and brought back": Case(
        store_with_one, remove_and_undo, judge_removed, frozenset({"whole", "removed"})
    ),
    "a torn capture is moved aside": Case(half_kept, opened, judge_swept, OLD_NEW),
    "a snapshot is put back": Case(
        with_snapshot, restore_snapshot, judge_restored_snapshot, frozenset({"old", "gone", "new"})
    ),
    "a visit goes onto a FAT stick": Case(
        with_stick, export, judge_export, frozenset({"old", "empty", "new"}), ("stick",)
    ),
    "a backup is written on a FAT stick": Case(
        with_backup, back_up, judge_backup, frozenset({"old", "unreadable", "new"}), ("stick",)
    ),
    "a backup is restored": Case(with_new_device, restore, judge_restored, OLD_NEW),
    "careless: no wait": Case(with_note, does_not_wait, judge_note, frozenset({"old", "new", "empty", "lost"})),
    "careless: the file alone": Case(
        with_note, waits_for_the_file_alone, judge_note, frozenset({"old", "new", "lost"})
    ),
    "careless: a rename on FAT": Case(
        with_choice, commit_by_rename, judge_rename, frozenset({"A", "B", "no choice", "lost"}), ("chooser",)
    ),
    "careless: tables": Case(
        with_loose_tables, trusts_the_disk, judge_loose, frozenset({"old", "damaged", "new", "lost"})
    ),
}


def folder_of(name: str, folder: Path) -> Path:
    return folder / name.replace(" ", "-")


if __name__ == "__main__":
    for name, case in CASES.items():
        print(f"<{name}>", flush=True)  # noqa: T201  # read by the tracing process
        case.act(folder_of(name, Path(sys.argv[1])), lambda word: print(word, flush=True))  # noqa: T201  # read by the tracing process
    print("<end>", flush=True)  # noqa: T201  # read by the tracing process
