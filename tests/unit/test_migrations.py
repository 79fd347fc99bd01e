"""Migrations: each only adds, so that a rolled-back release works on later tables; snapshots and their restoration."""

import ast
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from itertools import count
from os.path import commonprefix
from pathlib import Path

import pytest
from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from typer.testing import CliRunner

from device.clock import SystemClock, VirtualClock
from device.errors import StoreError, StoreFull
from services.errors import RecordNotFound, StoreDamaged
from services.records import schema
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.command import app
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.recovery_report import RecoveryReport
from services.records.snapshots import KEPT_VERSIONS, Snapshots
from services.records.visit import SlotCapture
from services.records.visit_repository import VisitRepository
from tests.golden.files import KEPT
from tests.project_files import nodes
from tests.second_migration import FIRST, SECOND, migrate, with_second_migration

FILES = {"raw.tiff": b"raw counts"}
STORE_OF_FIRST_RELEASE = KEPT / "data" / schema.DATABASE
KEYS = (f"{number:016x}" for number in count(1))
CHANGES = ("DROP ", "RENAME ", "DELETE ", "UPDATE ", "TRIGGER ")
# A trigger that only makes a digest null refuses nothing and changes no value that an older release reads or writes.
FORGETS_DIGEST = re.compile(
    r"CREATE TRIGGER \w+ AFTER [\w, ]+ ON \w+( WHEN (NEW|OLD)\.\w+ IS NOT NULL)?"
    r" BEGIN UPDATE \w+ SET record_sha256 = NULL WHERE \w+ = (NEW|OLD)\.\w+; END"
)
BINDS = ("CHECK", "UNIQUE", "REFERENCES", "PRIMARY KEY")


@pytest.fixture
def migrations(tmp_path: Path) -> Path:
    return with_second_migration(tmp_path)


def people(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), VirtualClock())


def use(folder: Path, number: int) -> None:
    """Store a capture in a slot of a new visit, an answer, and a dose of `number` J/cm2, as this release does."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        ledger(store).reserve(("OD",), number, 10.0)
        visits = people(store)
        visit = visits.answer(next(KEYS), visits.begin(next(KEYS)).id, "consent", "agreed").id
        target = visits.pictures.capture_target("OD", None, visit, "R-centre")
        report = CaptureReport(visit=target.visit, slot=target.slot)
        taken = Capture(f"c{number}", "OD", VirtualClock().wall(), True, "00ff", report, {})
        store.save(taken, FILES, target.write_rows)


def ledger(store: CaptureStore) -> DoseLedgerStore:
    return DoseLedgerStore(store.engine, VirtualClock(elapsed_s=1.0), 86_400.0, boot="boot")


def assert_complete(folder: Path, numbers: list[int]) -> None:
    """Assert that this release reads all that was stored, and has nothing to recover."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert (store.recovery, store.newly_quarantined) == (RecoveryReport(), ())
        assert {capture.id for capture in store.captures()} == {f"c{n}" for n in numbers}
        assert [store.read(f"c{n}", "raw.tiff") for n in numbers] == [FILES["raw.tiff"]] * len(numbers)
        assert ledger(store).spent_j_per_cm2("OD") == sum(numbers)
        slots = [visit.slots["R-centre"].captures for visit in people(store).visits(10)]
        assert sorted(taken.capture for captures in slots for taken in captures) == [f"c{n}" for n in numbers]


def test_tables_are_copied_and_migrated_and_a_rolled_back_release_works_on_them(
    tmp_path: Path, migrations: Path
) -> None:
    folder, clock = tmp_path / "store", VirtualClock(datetime(2026, 11, 21, tzinfo=UTC))
    use(folder, 1)
    assert not (folder / "snapshots").exists()
    for _ in range(2):
        migrate(folder, migrations, clock)  # the update
        assert [path.name for path in (folder / "snapshots").iterdir()] == ["s0001-20261121T000000.db"]
        clock.sleep(1)
    run(folder, "UPDATE captures SET note = 'by the later release'")
    assert version_of(folder / "snapshots" / "s0001-20261121T000000.db") == FIRST
    assert_complete(folder, [1])  # rolled back: this release reads and writes
    use(folder, 2)
    with CaptureStore(folder, reserve_bytes=0) as store:
        people(store).pictures.correct_laterality(next(KEYS), "c1", "OS", None)
        people(store).pictures.correct_laterality(next(KEYS), "c1", "OD", None)
    assert_complete(folder, [1, 2])
    assert version_of(folder / schema.DATABASE) == SECOND
    migrate(folder, migrations, clock)  # the update once more
    assert len(list((folder / "snapshots").iterdir())) == 1
    with closing(sqlite3.connect(folder / schema.DATABASE)) as tables:
        notes = tables.execute("SELECT id, note FROM captures ORDER BY id").fetchall()
    assert notes == [("c1", "by the later release"), ("c2", "")]


def run(folder: Path, *statements: str) -> None:
    with closing(sqlite3.connect(folder / schema.DATABASE, isolation_level=None)) as tables:
        for statement in statements:
            tables.execute(statement)


def version_of(path: Path) -> str:
    with closing(sqlite3.connect(path)) as tables:
        return str(tables.execute("SELECT version_num FROM alembic_version").fetchone()[0])


# Permitted changes of a migration


def definitions(migrations: Path, database: Path, version: str) -> dict[str, str]:
    """Return the SQL of each table, index and trigger of a database of the first release in that version, by name."""
    shutil.copy(STORE_OF_FIRST_RELEASE, database)
    config = Config()
    config.set_main_option("script_location", str(migrations))
    engine = schema.open_engine(database)
    with schema.for_writing(engine).begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, version)
    engine.dispose()
    return definitions_in(database)


def definitions_in(database: Path) -> dict[str, str]:
    with closing(sqlite3.connect(database)) as tables:
        rows = tables.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
    return {name: " ".join(sql.split()) for name, sql in rows}


def contracted(before: dict[str, str], after: dict[str, str]) -> Iterator[str]:
    """Yield each change that breaks an older release: all but new tables, plain indexes and optional columns."""
    for name, sql in before.items():
        new = after.get(name, "")
        same = len(commonprefix([sql, new]))  # noqa: RUF071  # SQL, not paths
        added, rest = new[same : len(new) - len(sql) + same].upper(), sql[same:]
        if len(new) < len(sql) or not new.endswith(rest):
            yield f"{name} is gone, renamed or recreated"
            continue
        yield from (f"{name} is bound by {word}" for word in BINDS if word in added)
        if "NOT NULL" in added and "DEFAULT" not in added:
            yield f"{name} needs what an older release does not write"
    for name in after.keys() - before.keys():
        trigger = "TRIGGER" in after[name] and not FORGETS_DIGEST.fullmatch(after[name])
        if trigger or re.search(r"UNIQUE INDEX .* ON (\w+)", after[name]):
            yield f"{name} binds an older table"


def marked(source: str) -> bool:
    """Return whether a migration declares `takes_away = "..."`: what it removes, and the last release in need."""
    targets = [node.targets[0] for node in nodes(source) if isinstance(node, ast.Assign)]
    return any(isinstance(target, ast.Name) and target.id == "takes_away" for target in targets)


def hand_made(source: str) -> list[str]:
    """Return SQL by hand that changes rows or names; docstrings are ignored."""
    upgrades = [node for node in nodes(source) if isinstance(node, ast.FunctionDef) and node.name == "upgrade"]
    calls = [node for upgrade in upgrades for node in ast.walk(upgrade) if isinstance(node, ast.Call)]
    statements = [str(arg.value).upper() for call in calls for arg in call.args if isinstance(arg, ast.Constant)]
    return [word for word in CHANGES for line in statements if word in line]


def test_a_migration_only_adds(tmp_path: Path, migrations: Path) -> None:
    """Of this release, and the made-up one."""
    scripts = sorted(ScriptDirectory(str(migrations)).walk_revisions(), key=lambda script: script.revision)
    assert [script.revision for script in scripts][-2:] == [FIRST, SECOND]
    before: dict[str, str] = {}
    for script in scripts:
        after = definitions(migrations, tmp_path / f"{script.revision}.sqlite", script.revision)
        source = Path(script.path).read_text(encoding="utf-8")
        assert marked(source) or not [*contracted(before, after), *hand_made(source)]
        before = after


def test_the_tables_are_those_that_the_code_describes(tmp_path: Path) -> None:
    """Also after the migrations of older tables: a column or an index that a migration lacks is found here."""
    CaptureStore(tmp_path / "new").close()
    migrated = definitions(schema.MIGRATIONS, tmp_path / schema.DATABASE, "head")
    assert migrated.keys() == definitions_in(tmp_path / "new" / schema.DATABASE).keys()
    with closing(sqlite3.connect(tmp_path / schema.DATABASE)) as tables:
        for name, table in schema.Base.metadata.tables.items():
            columns = {(row[1], row[2], bool(row[3])) for row in tables.execute(f"PRAGMA table_xinfo({name})")}
            assert columns == {(column.name, column.type.compile(), not column.nullable) for column in table.columns}, (
                name
            )
            indexes = {row[1] for row in tables.execute(f"PRAGMA index_list({name})") if row[3] == "c"}
            assert indexes == {index.name for index in table.indexes}, name


@pytest.mark.parametrize(
    ("change", "fine"),
    [
        ("ALTER TABLE files ADD COLUMN note TEXT", True),
        ("ALTER TABLE files ADD COLUMN note TEXT DEFAULT '' NOT NULL", True),
        ("CREATE TABLE notes (id TEXT PRIMARY KEY, capture TEXT REFERENCES captures(id)) STRICT", True),
        ("CREATE INDEX files_by_sum ON files (sha256)", True),
        ("ALTER TABLE files ADD COLUMN note TEXT CHECK (note != 'x')", False),
        ("ALTER TABLE files ADD COLUMN note TEXT REFERENCES captures(id)", False),
        ("ALTER TABLE files DROP COLUMN name2", False),
        ("ALTER TABLE files RENAME COLUMN sha256 TO sum", False),
        ("ALTER TABLE files RENAME TO file", False),
        ("DROP TABLE files", False),
        ("DROP INDEX captures_by_time", False),
        ("CREATE UNIQUE INDEX one_sum ON files (sha256)", False),
        ("CREATE TRIGGER deny BEFORE INSERT ON files BEGIN SELECT RAISE(ABORT, 'no'); END", False),
    ],
)
def test_a_change_that_breaks_an_older_release_is_detected(change: str, fine: bool, tmp_path: Path) -> None:
    CaptureStore(tmp_path).close()
    run(tmp_path, "ALTER TABLE files ADD COLUMN name2 TEXT")
    before = definitions_in(tmp_path / schema.DATABASE)
    run(tmp_path, change)
    assert (list(contracted(before, definitions_in(tmp_path / schema.DATABASE))) == []) == fine


# Snapshots


def test_without_space_for_a_snapshot_no_migration_runs(tmp_path: Path, migrations: Path) -> None:
    folder = tmp_path / "store"
    use(folder, 1)
    with pytest.raises(StoreFull, match="before they are changed") as raised:
        migrate(folder, migrations, SystemClock(), free_bytes=9_000_000)
    assert "nothing was changed" in raised.value.remedy
    assert (version_of(folder / schema.DATABASE), list((folder / "snapshots").iterdir())) == (FIRST, [])


def test_the_last_snapshot_of_each_of_the_last_versions_is_kept(tmp_path: Path) -> None:
    CaptureStore(tmp_path).close()
    clock = VirtualClock(datetime(2035, 1, 1, tzinfo=UTC))
    snapshots = Snapshots(tmp_path / schema.DATABASE, clock)
    for number in range(1, KEPT_VERSIONS + 3):
        snapshots.create(f"s{number:04}")
    clock.start = datetime(2020, 1, 1, tzinfo=UTC)  # a clock that was set back must not delete the newest
    snapshots.create(f"s{KEPT_VERSIONS + 2:04}")
    assert snapshots.names() == ["s0003-20350101T000000.db", "s0004-20350101T000000.db", "s0005-20200101T000000.db"]


def restore(folder: Path, name: str) -> str:
    done = CliRunner().invoke(app, ["restore", name, "--data", str(folder), "--yes"], catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


@pytest.mark.parametrize("harm", ["none", "damaged", "gone"])
def test_a_snapshot_is_restored(harm: str, tmp_path: Path) -> None:
    database = tmp_path / schema.DATABASE
    use(tmp_path, 1)
    Snapshots(database, SystemClock()).create(FIRST)
    use(tmp_path, 2)
    if harm == "damaged":
        database.write_bytes(b"not tables" * 1000)
    elif harm == "gone":
        database.unlink()
    names = CliRunner().invoke(app, ["list", "--data", str(tmp_path)]).output.split()
    words = restore(tmp_path, names[0])
    assert "1 captures were kept since, from c2 on" in words
    assert (tmp_path / "snapshots" / "replaced-1" / database.name).exists() == (harm != "gone")
    with closing(sqlite3.connect(database)) as tables:
        assert tables.execute("SELECT id FROM captures").fetchall() == [("c1",)]
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        assert (store.recovery.adopted, store.newly_quarantined) == (["c2"], ())
        assert ledger(store).spent_j_per_cm2("OD") == 3.0
    assert_complete(tmp_path, [1, 2])


def test_restoring_is_refused_for_a_running_instrument_and_for_a_damaged_snapshot(tmp_path: Path) -> None:
    with CaptureStore(tmp_path) as store:
        snapshots = Snapshots(tmp_path / schema.DATABASE, SystemClock())
        snapshots.create(FIRST)
        assert store.captures() == []
        with pytest.raises(StoreError, match="is running"):
            snapshots.restore(snapshots.names()[0])
    with pytest.raises(RecordNotFound):
        snapshots.restore(f"../{schema.DATABASE}")
    name = snapshots.names()[0]
    path = snapshots.folder / name
    content = bytearray(path.read_bytes())
    content[4096:12288] = bytes(8192)
    path.write_bytes(content)
    with pytest.raises(StoreDamaged, match="damaged"):
        snapshots.restore(name)


# Columns of a capture that are computed from its report


@pytest.mark.parametrize("report", ["{", "", "null", "[]", "3", '{"slot": 3, "verdict": "x", "laterality": [1]}'])
def test_a_report_without_usable_entries_has_empty_columns(report: str, tmp_path: Path) -> None:
    """The disk may have damaged it; its capture keeps its slot."""
    use(tmp_path, 1)
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        with closing(sqlite3.connect(tmp_path / schema.DATABASE, isolation_level=None)) as other:
            other.execute("PRAGMA ignore_check_constraints = ON")
            other.execute("UPDATE captures SET report = ?", (report,))
            (columns,) = other.execute("SELECT visit, slot, verdict, laterality FROM captures").fetchall()
        assert columns == (None, None, None, None)
        assert [visit.slots["R-centre"].captures for visit in people(store).visits(10)] == [(SlotCapture("c1", None),)]
