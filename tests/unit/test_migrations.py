"""Captures outlive versions, in both directions: a migration only adds, so the version before goes on where it is."""

import ast
import re
import shutil
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from os.path import commonprefix
from pathlib import Path

import pytest
from alembic.script import ScriptDirectory
from typer.testing import CliRunner

from device.clock import SystemClock, VirtualClock
from device.errors import NotKept, StoreDamaged, StoreError, StoreFull
from services.records import schema
from services.records.command import app
from services.records.light_book import LightBook
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.snapshots import KEPT, Snapshots
from services.records.store import Store
from tests.earlier import RAW, READS, WRITES, Release, shelf_of
from tests.house import files, nodes, text

VERSIONS = sorted(script.revision for script in ScriptDirectory.from_config(schema.migration_config()).walk_revisions())
HEAD = VERSIONS[-1]
MIGRATIONS = [name for name in files() if name.startswith("services/records/migrations/versions/r")]
CHANGES = ("DROP ", "RENAME ", "DELETE ", "UPDATE ", "TRIGGER ")
BINDS = ("CHECK", "UNIQUE", "REFERENCES", "PRIMARY KEY")


@pytest.mark.parametrize("version", WRITES)
def test_a_shelf_of_any_version_comes_forward_is_used_by_its_own_release_and_comes_forward_again(
    version: str, tmp_path: Path
) -> None:
    earlier = Release(shelf_of(tmp_path, version), version)
    earlier.write(1)
    first = earlier.read(1)
    assert all(first[:3])
    with Store(tmp_path, reserve_bytes=0) as store:
        assert_whole(store, version, [1])
    assert earlier.read(1) == first
    earlier.write(2)  # rolled back: it reads and writes
    second = earlier.read(2)
    with Store(tmp_path, reserve_bytes=0) as store:
        assert_whole(store, version, [1, 2])
        assert store.swept == ()
    assert (earlier.read(1), earlier.read(2)) == (first, second)
    assert version_of(tmp_path / "shelf.sqlite") == HEAD


def assert_whole(store: Store, version: str, numbers: list[int]) -> None:
    """This release finds all that an earlier one wrote, by its own questions."""
    assert {one.id for one in store.captures()} == {f"c{n}" for n in numbers}
    assert [store.read(f"c{n}", "raw.tiff") for n in numbers] == [RAW] * len(numbers)
    if version >= "r0002":
        book = LightBook(store.engine, VirtualClock(elapsed_s=1.0), 86_400.0, boot="boot")
        assert book.spent_j_per_cm2("OD") == sum(numbers)
    if version >= "r0003":
        visits = People(store.engine, load_protocol(), SystemClock()).visits(10)
        assert {(one.id, one.fields["age"]) for one in visits} == {(f"v{n}", 51) for n in numbers}


def test_every_version_of_the_tables_has_the_statements_of_its_release() -> None:
    assert list(WRITES) == list(READS) == VERSIONS


def version_of(path: Path) -> str:
    connection = sqlite3.connect(path)
    said = connection.execute("SELECT version_num FROM alembic_version").fetchone()[0]
    connection.close()
    return str(said)


# What a migration may do


def tables(folder: Path) -> dict[str, str]:
    connection = sqlite3.connect(folder / "shelf.sqlite")
    rows = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
    connection.close()
    return {name: " ".join(sql.split()) for name, sql in rows}


def contracted(before: dict[str, str], after: dict[str, str]) -> Iterator[str]:
    """What an older release would trip over: anything but new tables, new plain indexes and new optional columns."""
    for name, sql in before.items():
        new = after.get(name, "")
        same = len(commonprefix([sql, new]))  # noqa: RUF071  # SQL, not paths
        added, rest = new[same : len(new) - len(sql) + same].upper(), sql[same:]
        if len(new) < len(sql) or not new.endswith(rest):
            yield f"{name} is gone, renamed or made anew"
            continue
        yield from (f"{name} is bound by {word}" for word in BINDS if word in added)
        if "NOT NULL" in added and "DEFAULT" not in added:
            yield f"{name} needs what an older release does not write"
    for name in after.keys() - before.keys():
        if "TRIGGER" in after[name] or re.search(r"UNIQUE INDEX .* ON (\w+)", after[name]):
            yield f"{name} binds an older table"


def marked(name: str) -> bool:
    """Whether a migration says `takes_away = "..."`: what, and which release was the last to need it."""
    told = [node.targets[0] for node in nodes(text(name)) if isinstance(node, ast.Assign)]
    return any(isinstance(target, ast.Name) and target.id == "takes_away" for target in told)


def hand_made(name: str) -> list[str]:
    """SQL by hand that changes rows or names; docstrings are no SQL."""
    upgrades = [node for node in nodes(text(name)) if isinstance(node, ast.FunctionDef) and node.name == "upgrade"]
    calls = [node for one in upgrades for node in ast.walk(one) if isinstance(node, ast.Call)]
    said = [str(arg.value).upper() for call in calls for arg in call.args if isinstance(arg, ast.Constant)]
    return [word for word in CHANGES for line in said if word in line]


@pytest.mark.parametrize("name", MIGRATIONS)
def test_a_migration_only_adds(name: str, tmp_path: Path) -> None:
    version = Path(name).name.split("_")[0]
    earlier = [one for one in VERSIONS if one < version]
    before = tables(shelf_of(tmp_path / "before", earlier[-1])) if earlier else {}
    after = tables(shelf_of(tmp_path / "after", version))
    assert marked(name) or not [*contracted(before, after), *hand_made(name)]


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
def test_what_an_older_release_trips_over_is_noticed(change: str, fine: bool, tmp_path: Path) -> None:
    folder = shelf_of(tmp_path, "r0001")
    connection = sqlite3.connect(folder / "shelf.sqlite")
    connection.execute("ALTER TABLE files ADD COLUMN name2 TEXT")
    before = tables(folder)
    connection.execute(change)
    connection.commit()
    connection.close()
    assert (list(contracted(before, tables(folder))) == []) == fine


# Snapshots


def test_a_snapshot_is_made_before_a_migration_and_never_without_one(tmp_path: Path) -> None:
    Release(shelf_of(tmp_path, "r0001"), "r0001").write(1)
    clock = VirtualClock(datetime(2026, 11, 21, tzinfo=UTC))
    for _ in range(2):
        with Store(tmp_path, clock=clock):
            assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["r0001-20261121T000000.db"]
        clock.sleep(1)
    snapshot = tmp_path / "snapshots" / "r0001-20261121T000000.db"
    assert version_of(snapshot) == "r0001"
    shutil.copy(snapshot, tmp_path / "shelf.sqlite")
    assert Release(tmp_path, "r0001").read(1)[1][0][0] == "c1"
    with Store(tmp_path / "new", clock=clock):
        assert not (tmp_path / "new" / "snapshots").exists()


def test_without_room_for_a_snapshot_nothing_is_migrated(tmp_path: Path) -> None:
    shelf_of(tmp_path, "r0002")
    with pytest.raises(StoreFull, match="before they are changed") as told:
        Store(tmp_path, free_bytes=lambda folder: 9_000_000)
    assert "nothing was changed" in told.value.remedy
    assert (version_of(tmp_path / "shelf.sqlite"), list((tmp_path / "snapshots").iterdir())) == ("r0002", [])


def test_the_last_of_each_of_the_last_versions_stay(tmp_path: Path) -> None:
    shelf_of(tmp_path, "r0001")
    clock = VirtualClock(datetime(2035, 1, 1, tzinfo=UTC))
    snapshots = Snapshots(tmp_path / "shelf.sqlite", clock)
    for number in range(1, KEPT + 3):
        snapshots.make(f"r{number:04}")
    clock.start = datetime(2020, 1, 1, tzinfo=UTC)  # a clock that was set back does not lose the newest
    snapshots.make(f"r{KEPT + 2:04}")
    assert snapshots.names() == ["r0003-20350101T000000.db", "r0004-20350101T000000.db", "r0005-20200101T000000.db"]


def restore(folder: Path, name: str) -> str:
    done = CliRunner().invoke(app, ["restore", name, "--data", str(folder), "--yes"], catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


@pytest.mark.parametrize("harm", ["none", "damaged", "gone"])
def test_a_technician_goes_back_to_a_snapshot(harm: str, tmp_path: Path) -> None:
    earlier = Release(shelf_of(tmp_path, "r0003"), "r0003")
    earlier.write(1)
    Snapshots(tmp_path / "shelf.sqlite", SystemClock()).make("r0003")
    earlier.write(2)
    if harm == "damaged":
        (tmp_path / "shelf.sqlite").write_bytes(b"not tables" * 1000)
    elif harm == "gone":
        (tmp_path / "shelf.sqlite").unlink()
    said = CliRunner().invoke(app, ["list", "--data", str(tmp_path)]).output.split()
    words = restore(tmp_path, said[0])
    assert "1 captures were kept since, from c2 on" in words
    aside = tmp_path / "snapshots" / "replaced-1"
    assert (aside / "shelf.sqlite").exists() == (harm != "gone")
    with Store(tmp_path, reserve_bytes=0) as store:
        assert ([one.id for one in store.captures()], store.swept) == (["c1"], ("c2",))


def test_a_running_instrument_and_a_bad_snapshot_are_refused(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        snapshots = Snapshots(tmp_path / "shelf.sqlite", SystemClock())
        snapshots.make(HEAD)
        assert store.captures() == []
        with pytest.raises(StoreError, match="is running"):
            snapshots.put_back(snapshots.names()[0])
    with pytest.raises(NotKept):
        snapshots.put_back("../shelf.sqlite")
    name = snapshots.names()[0]
    path = snapshots.folder / name
    content = bytearray(path.read_bytes())
    content[4096:12288] = bytes(8192)
    path.write_bytes(content)
    with pytest.raises(StoreDamaged, match="damaged"):
        snapshots.put_back(name)
