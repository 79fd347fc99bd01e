"""What is done while the power may go: what it begins with, and what must be true of whatever is left.

Run as a module, this file is the victim: it does one thing after another, and says when each is done.
"""

import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

from device.calibration.archive import Archive, write_synced
from device.clock import SystemClock, VirtualClock
from device.errors import CalibrationMissing, StoreDamaged
from device.values import Capture
from services.records.light_book import LightBook
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.snapshots import Snapshots
from services.records.store import Store
from tests.earlier import RAW, Release, shelf_of
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
)  # fmt: skip
from tests.unit.test_archive import WHO, calibration

OLD, NEW = (replace(calibration(black_dn), dark_dn=None, bad=None) for black_dn in (64.25, 65.0))
ADOPTED = "adopted"


def capture(name: str, second: int = 0) -> Capture:
    taken_at = datetime(2026, 3, 1, 12, tzinfo=UTC) + timedelta(seconds=second)
    return Capture(name, "OS", taken_at, False, "00ff", {"method": "wiener"}, {})


def people(store: Store) -> People:
    return People(store.engine, load_protocol(), SystemClock())


# What is done, what it begins with, and what must be true of whatever is left; `said` is what was said to be done.

Prepare = Callable[[Path], None]
Act = Callable[[Path, Callable[[str], None]], None]
Judge = Callable[[Path, list[str]], str]


@dataclass(frozen=True)
class Case:
    prepare: Prepare
    act: Act
    judge: Judge
    outcomes: frozenset[str]
    fat: tuple[str, ...] = ()  # folders that are FAT


def shelf_with_one(folder: Path) -> None:
    with Store(folder, reserve_bytes=0) as store:
        store.keep(capture("before"), FILES)


def keep(folder: Path, say: Callable[[str], None]) -> None:
    with Store(folder, reserve_bytes=0) as store:
        for number in (1, 2):
            store.keep(capture(f"new{number}", number), FILES)
            say(f"new{number}")


def judge_kept(folder: Path, said: list[str]) -> str:
    with Store(folder, reserve_bytes=0) as store:
        listed = {one.id for one in store.captures()}
        assert {*said, *(["before"] if (folder / "captures" / "before").exists() else [])} <= listed
        for id in listed:
            assert {name: store.read(id, name) for name in store.get(id).files} == FILES
        assert {path.name for path in (folder / "captures").iterdir()} == listed
        return "new" if "new1" in listed else "torn" if store.swept else "old"


def judge_kept_beside(folder: Path, said: list[str]) -> str:
    assert (folder / "captures" / "before").is_dir()
    return judge_kept(folder, said)


def answer(folder: Path, say: Callable[[str], None]) -> None:
    with Store(folder, reserve_bytes=0) as store:
        mine, keys = people(store), (f"{number:016x}" for number in count())
        visit = mine.begin(next(keys)).id
        for age in range(1, 6):
            mine.answer(next(keys), visit, "age", age)
            say(str(age))
        mine.finish(next(keys), visit)
        say("6")


def judge_answers(folder: Path, said: list[str]) -> str:
    with Store(folder, reserve_bytes=0) as store:
        visits, last = people(store).visits(10), int(said[-1]) if said else 0
        if not visits:
            assert not said
            return "old"
        reached = 6 if visits[0].finished_at else visits[0].fields.get("age", 0)
        assert reached in (last, last + 1)
        return "new"


def shine(folder: Path, say: Callable[[str], None]) -> None:
    with Store(folder, reserve_bytes=0) as store:
        book = LightBook(store.engine, VirtualClock(), 86_400.0, boot="boot")
        book.reserve(("OD",), 1.0, 10.0)
        say("reserved")


def judge_light(folder: Path, said: list[str]) -> str:
    with Store(folder, reserve_bytes=0) as store:
        spent = LightBook(store.engine, VirtualClock(), 86_400.0, boot="boot").spent_j_per_cm2("OD")
        assert spent == 1.0 or not said
        return "new" if spent else "old"


def calibrated(folder: Path) -> None:
    (folder / "calibrations").mkdir()
    Archive(folder / "calibrations" / "head").keep(OLD, WHO)


def recalibrate(folder: Path, say: Callable[[str], None]) -> None:
    archive = Archive(folder / "calibrations" / "head")
    archive.keep(NEW, WHO)
    say(NEW.id)
    archive.use(OLD.id)
    say(OLD.id)


def take_in(folder: Path, say: Callable[[str], None]) -> None:
    """What is imported was exported from elsewhere."""
    archive = Archive(folder / "calibrations" / "head")
    archive.adopt(Archive(folder / "elsewhere").files(NEW.id))
    say(ADOPTED)


def to_take_in(folder: Path) -> None:
    calibrated(folder)
    Archive(folder / "elsewhere").add(NEW, WHO)


def first_calibration(folder: Path, say: Callable[[str], None]) -> None:
    Archive(folder / "calibrations" / "head").keep(NEW, WHO)
    say(NEW.id)


def judge_calibration(folder: Path, said: list[str]) -> str:
    archive = Archive(folder / "calibrations" / "head")
    kept = {archive.load(id).calibration.id for id in archive.ids()}
    try:
        in_force = archive.load().calibration.id
    except CalibrationMissing:
        assert not said
        return "none"
    if said == [ADOPTED]:
        assert NEW.id in kept
    elif said and not (said == [NEW.id] and in_force == OLD.id and OLD.id in kept):
        assert in_force == said[-1]
    return "new" if NEW.id in kept else "old"


def earlier_shelf(folder: Path) -> None:
    shelf_of(folder / "data", "r0001")
    Release(folder / "data", "r0001").write(1)


def migrate(folder: Path, say: Callable[[str], None]) -> None:
    with Store(folder / "data", reserve_bytes=0):
        say("open")


def judge_migration(folder: Path, said: list[str]) -> str:
    """The version before reads it at any moment; every snapshot is whole; this version opens it."""
    data = folder / "data"
    snapshots = list(data.glob("snapshots/*.db"))
    for path in snapshots:
        connection = sqlite3.connect(path)
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("SELECT version_num FROM alembic_version").fetchone() == ("r0001",)
        assert connection.execute("SELECT id FROM captures").fetchall() == [("c1",)]
        connection.close()
    connection = sqlite3.connect(data / "shelf.sqlite")
    (version,) = connection.execute("SELECT version_num FROM alembic_version").fetchone()
    connection.close()
    assert version == "r0001" or snapshots, "changed without a snapshot"
    assert version != "r0001" or not said
    assert Release(data, "r0001").read(1)[1][0][0] == "c1"
    with Store(data, reserve_bytes=0) as store:
        assert [one.id for one in store.captures()] == ["c1"]
        assert store.read("c1", "raw.tiff") == RAW
        assert len(list(data.glob("snapshots/*.db"))) == 1
    return "old" if version == "r0001" else "new"


def half_kept(folder: Path) -> None:
    shelf_with_one(folder)
    (folder / "captures" / ".half.part").mkdir()
    (folder / "captures" / ".half.part" / "raw.tiff").write_bytes(FILES["raw.tiff"])


def judge_swept(folder: Path, said: list[str]) -> str:
    before = {path.name for path in (folder / "torn").iterdir()}
    with Store(folder, reserve_bytes=0) as store:
        kept = [path.read_bytes() for path in (folder / "torn").glob("half*/raw.tiff")]
        assert kept
        assert set(kept) == {FILES["raw.tiff"]}
        assert [one.id for one in store.captures()] == ["before"]
    return "new" if before else "old"


def with_snapshot(folder: Path) -> None:
    Release(shelf_of(folder / "data", "r0003"), "r0003").write(1)
    snapshots(folder).make("r0003")
    Release(folder / "data", "r0003").write(2)


def snapshots(folder: Path) -> Snapshots:
    return Snapshots(folder / "data" / "shelf.sqlite", VirtualClock())


def put_back(folder: Path, say: Callable[[str], None]) -> None:
    snapshots(folder).put_back(snapshots(folder).names()[0])
    say("back")


def judge_put_back(folder: Path, said: list[str]) -> str:
    """In between it refuses to open, and putting back once more mends it."""
    outcome = ""
    try:
        Store(folder / "data").close()
    except StoreDamaged:
        assert not said
        put_back(folder, lambda word: None)
        outcome = "refused"
    with Store(folder / "data") as store:
        listed = [one.id for one in store.captures()]
    assert listed == ["c1"] or (listed == ["c2", "c1"] and not said)
    return outcome or ("new" if listed == ["c1"] else "old")


# Programs that do not wait for the disk: if these were not found out, nothing above would mean anything.


def with_note(folder: Path) -> None:
    (folder / "note").write_bytes(b"old")


def does_not_wait(folder: Path, say: Callable[[str], None]) -> None:
    (folder / "part").write_bytes(b"new")
    (folder / "part").rename(folder / "note")
    say("new")


def waits_for_the_file_alone(folder: Path, say: Callable[[str], None]) -> None:
    write_synced(folder / "part", b"new")
    (folder / "part").rename(folder / "note")
    say("new")


def judge_note(folder: Path, said: list[str]) -> str:
    note = (folder / "note").read_bytes().decode()
    return "lost" if said and note != "new" else note or "empty"


def with_loose_tables(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "loose.sqlite", isolation_level=None)) as tables:
        tables.execute("CREATE TABLE notes (note BLOB)")
        tables.execute("INSERT INTO notes VALUES (zeroblob(60000))")


def trusts_the_disk(folder: Path, say: Callable[[str], None]) -> None:
    with closing(sqlite3.connect(folder / "loose.sqlite", isolation_level=None)) as tables:
        tables.execute("PRAGMA synchronous = OFF")
        tables.execute("INSERT INTO notes SELECT randomblob(60000)")
        say("new")


def judge_loose(folder: Path, said: list[str]) -> str:
    with closing(sqlite3.connect(folder / "loose.sqlite")) as tables:
        try:
            number = len(tables.execute("SELECT hex(note) FROM notes").fetchall())
            whole = tables.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        except sqlite3.DatabaseError:
            return "damaged"
    return "damaged" if not whole else "lost" if said and number < 2 else "new" if number == 2 else "old"


def nothing(folder: Path) -> None:
    pass


def opened(folder: Path, say: Callable[[str], None]) -> None:
    with Store(folder, reserve_bytes=0):
        say("open")


OLD_NEW = frozenset({"old", "new"})
CASES = {
    "a capture is kept": Case(shelf_with_one, keep, judge_kept_beside, frozenset({"old", "torn", "new"})),
    "the first capture of a new device": Case(nothing, keep, judge_kept, frozenset({"old", "torn", "new"})),
    "answers of a visit": Case(shelf_with_one, answer, judge_answers, OLD_NEW),
    "the book of light": Case(shelf_with_one, shine, judge_light, OLD_NEW),
    "a calibration is kept and taken back": Case(calibrated, recalibrate, judge_calibration, OLD_NEW),
    "a calibration is taken in": Case(to_take_in, take_in, judge_calibration, OLD_NEW),
    "the first calibration": Case(nothing, first_calibration, judge_calibration, frozenset({"none", "new"})),
    "a slot is committed": Case(with_choice, commit, judge_choice, frozenset("AB"), ("chooser",)),
    "tables are brought forward": Case(earlier_shelf, migrate, judge_migration, OLD_NEW),
    "a torn capture is moved aside": Case(half_kept, opened, judge_swept, OLD_NEW),
    "a snapshot is put back": Case(with_snapshot, put_back, judge_put_back, frozenset({"old", "refused", "new"})),
    "a visit goes onto a FAT stick": Case(
        with_stick, export, judge_export, frozenset({"old", "empty", "new"}), ("stick",)
    ),
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
        print(f"<{name}>", flush=True)  # noqa: T201  # read by whoever traces it
        case.act(folder_of(name, Path(sys.argv[1])), lambda word: print(word, flush=True))  # noqa: T201  # read by whoever traces it
    print("<end>", flush=True)  # noqa: T201  # read by whoever traces it
