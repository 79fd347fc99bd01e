"""The shelf in ordinary weather: what is kept comes back, in order, and what is wrong is said."""

import hashlib
import re
import shutil
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from hypothesis import given, settings
from hypothesis import strategies as st

from device.errors import NotKept, SettingError, StoreDamaged, StoreError, StoreFull
from device.values import Capture
from services.records import schema
from services.records.store import WHOLE, Store

MEMORY = Path("/dev/shm")  # order does not depend on the disk, and many shelves are made
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
FILES = {"raw.tiff": b"raw" * 1000, "picture.png": b"", "report.json": b"{}"}


def capture(name: str = "20260301T120000-OD-aa", taken_at: datetime = NOON, **report: object) -> Capture:
    return Capture(name, "OD", taken_at, True, "00ff", dict(report), {})


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "data" / "shelf", reserve_bytes=0) as opened:
        yield opened


def database(folder: Path) -> sqlite3.Connection:
    return sqlite3.connect(folder / "shelf.sqlite", isolation_level=None)


def test_what_is_kept_comes_back_after_a_restart(store: Store) -> None:
    asked = capture(method="wiener", seconds={"solve": 0.25}, refraction_dpt=None)
    kept = store.keep(asked, FILES)
    assert kept == asked.with_files({name: hashlib.sha256(content).hexdigest() for name, content in FILES.items()})
    store.close()
    with Store(store.folder) as again:
        assert again.swept == ()
        assert again.captures() == [kept]
        assert again.get(kept.id) == kept
        assert {name: again.read(kept.id, name) for name in kept.files} == FILES


def test_a_moment_in_another_zone_is_the_same_moment(store: Store) -> None:
    there = NOON.astimezone(timezone(timedelta(hours=5, minutes=30)))
    store.keep(capture(taken_at=there), FILES)
    assert store.get(capture().id).taken_at == NOON
    assert store.get(capture().id).taken_at.utcoffset() == timedelta(0)
    with pytest.raises(SettingError, match="no time zone"):
        store.keep(capture("b", NOON.replace(tzinfo=None)), FILES)


def test_a_report_with_numbers_that_are_none_is_kept_as_null(store: Store) -> None:
    report = {"residual": float("nan"), "noise_dn": np.float32(1.5), "warnings": ("dim",), "quality": {"a": [np.inf]}}
    store.keep(capture(**report), FILES)
    expected = {"residual": None, "noise_dn": 1.5, "warnings": ["dim"], "quality": {"a": [None]}}
    assert store.get(capture().id).report == expected
    with pytest.raises(SettingError, match="cannot be written down"):
        store.keep(capture("b", at=object()), FILES)
    assert [path.name for path in (store.folder / "captures").iterdir()] == [capture().id]


moments = st.datetimes(datetime(2020, 1, 1), datetime(2020, 1, 1, 0, 0, 3), timezones=st.timezones())


@given(st.lists(moments, max_size=7), st.integers(1, 3))
@settings(max_examples=12, deadline=None)
def test_the_list_is_newest_first_and_pages_meet_without_a_gap(taken: list[datetime], page: int) -> None:
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        Store(Path(folder), reserve_bytes=0) as store,
    ):
        for number, moment in enumerate(taken):
            store.keep(capture(f"{number}", moment), {"a": b"1"})
        expected = [f"{n}" for n in reversed(range(len(taken)))]  # as they were kept: dates may be set back meanwhile
        assert [kept.id for kept in store.captures()] == expected
        paged: list[str] = []
        while part := store.captures(page, before=paged[-1] if paged else None):
            assert len(part) <= page
            paged += [kept.id for kept in part]
        assert paged == expected


def test_a_list_needs_a_length_and_a_known_beginning(store: Store) -> None:
    with pytest.raises(SettingError):
        store.captures(0)
    with pytest.raises(NotKept):
        store.captures(before="never")


@pytest.mark.parametrize("id", ["never", "", "../shelf.sqlite", "a/b", "\0", "\ud800", "x" * 300])
def test_an_unknown_capture_is_not_kept(store: Store, id: str) -> None:
    with pytest.raises(NotKept):
        store.get(id)
    with pytest.raises(NotKept):
        store.read(id, "raw.tiff")


@pytest.mark.parametrize(
    "name", ["../x/raw.tiff", "/etc/passwd", "..", "", "RAW.TIFF", "other", "./raw.tiff", "\ud800"]
)
def test_no_name_leads_out_of_a_capture(store: Store, name: str) -> None:
    store.keep(capture(), FILES)
    with pytest.raises(NotKept, match="no file"):
        store.read(capture().id, name)


@pytest.mark.parametrize("name", ["..", ".hidden", "a/b", "", "-x", "a\n", "\ud800", "ü"])
def test_names_that_are_no_names_are_refused_before_anything_is_written(store: Store, name: str) -> None:
    with pytest.raises(SettingError, match="cannot name"):
        store.keep(capture(name), FILES)
    with pytest.raises(SettingError, match="cannot name"):
        store.keep(capture(), {name: b"1"})
    with pytest.raises(SettingError, match="nothing to keep"):
        store.keep(capture(), {})
    assert list((store.folder / "captures").iterdir()) == []


def test_a_second_capture_of_the_same_name_is_refused_and_the_first_stays(store: Store) -> None:
    store.keep(capture(), FILES)
    with pytest.raises(StoreError, match="already"):
        store.keep(capture(), {"raw.tiff": b"other"})
    assert store.read(capture().id, "raw.tiff") == FILES["raw.tiff"]


def test_one_flipped_bit_is_found(store: Store) -> None:
    store.keep(capture(), FILES)
    path = store.folder / "captures" / capture().id / "raw.tiff"
    content = bytearray(path.read_bytes())
    content[1234] ^= 1
    path.write_bytes(content)
    with pytest.raises(StoreDamaged, match="SHA-256"):
        store.read(capture().id, "raw.tiff")
    assert store.read(capture().id, "report.json") == b"{}"
    path.unlink()
    with pytest.raises(StoreDamaged, match="cannot be read"):
        store.read(capture().id, "raw.tiff")


def test_a_row_without_its_folder_is_listed_and_called_damaged(store: Store) -> None:
    store.keep(capture("a"), FILES)
    store.keep(capture("b", NOON + timedelta(seconds=1)), FILES)
    shutil.rmtree(store.folder / "captures" / "a")
    store.close()
    with Store(store.folder, reserve_bytes=0) as again:
        assert [kept.id for kept in again.captures()] == ["b", "a"]
        with pytest.raises(StoreDamaged, match="gone"):
            again.get("a")
        with pytest.raises(StoreDamaged):
            again.read("a", "raw.tiff")
        assert again.get("b").id == "b"


def test_a_torn_capture_is_moved_aside_whole_and_never_over_another(store: Store) -> None:
    store.keep(capture("kept"), FILES)
    store.close()
    for name in (".torn.part", "torn", "renamed"):
        (store.folder / "captures" / name).mkdir()
        (store.folder / "captures" / name / "raw.tiff").write_bytes(name.encode())
    (store.folder / "captures" / "note").write_bytes(b"a file that is none of ours stays")
    with Store(store.folder, reserve_bytes=0) as again:
        assert again.swept == ("torn", "renamed", "torn-2")
        assert [kept.id for kept in again.captures()] == ["kept"]
        found = {path.parent.name: path.read_bytes() for path in (store.folder / "torn").glob("*/*")}
        assert found == {"torn": b".torn.part", "torn-2": b"torn", "renamed": b"renamed"}
        assert again.read("kept", "raw.tiff") == FILES["raw.tiff"]
    with Store(store.folder) as once_more:
        assert once_more.swept == ()


def test_a_capture_with_all_its_files_that_was_never_renamed_is_moved_aside_and_named(store: Store) -> None:
    """The process died between the last file and the name: no row promises it, and nothing of it is lost."""
    store.close()
    part = store.folder / "captures" / ".whole.part"
    part.mkdir()
    for name in WHOLE:
        (part / name).write_bytes(b"content")
    with Store(store.folder, reserve_bytes=0) as again:
        assert again.swept == ("whole",)
        assert again.orphans() == ["whole"]
        assert again.torn() == {}
        assert {path.name for path in (store.folder / "torn" / "whole").iterdir()} == WHOLE


@pytest.mark.parametrize("leave", ["nothing", "an empty file"])
def test_a_lost_database_is_reported_and_the_captures_stay_where_they_are(store: Store, leave: str) -> None:
    store.keep(capture(), FILES)
    store.close()
    (store.folder / "shelf.sqlite").unlink()
    if leave == "an empty file":
        (store.folder / "shelf.sqlite").touch()
    with pytest.raises(StoreDamaged, match="is gone"):
        Store(store.folder)
    assert (store.folder / "captures" / capture().id / "raw.tiff").exists()


def test_a_database_that_is_none_is_called_damaged(store: Store) -> None:
    store.close()
    (store.folder / "shelf.sqlite").write_bytes(b"not a database at all" * 1000)
    with pytest.raises(StoreDamaged, match="not a database"):
        Store(store.folder)


def test_when_the_disk_goes_away_the_shelf_says_so(store: Store) -> None:
    shutil.rmtree(store.folder / "captures")
    with pytest.raises(StoreError, match="disk refused") as told:
        store.keep(capture(), FILES)
    assert not isinstance(told.value, StoreFull)
    assert store.captures() == []


def test_too_little_room_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    need = sum(map(len, FILES.values()))
    free = [1000 + need]
    with Store(tmp_path, reserve_bytes=1000, free_bytes=lambda folder: free[0]) as store:
        store.keep(capture("fits"), FILES)
        free[0] -= 1
        with pytest.raises(StoreFull, match="reserve"):
            store.keep(capture("does-not"), FILES)
        assert [path.name for path in (tmp_path / "captures").iterdir()] == ["fits"]


def test_what_is_torn_gives_its_room_to_a_new_picture_the_oldest_first(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing of it is removed before, however old it is; it counts as room that is left."""
    size_bytes, torn = 20_000, ("20260301T120000-OD-aa", "20260301T120100-OD-bb", "20260301T120200-OD-cc")

    def free_bytes(folder: Path) -> int:
        return 60_000 - sum(path.stat().st_size for path in folder.rglob("*/*/*"))

    with Store(tmp_path, reserve_bytes=0, free_bytes=free_bytes) as store:
        for name in torn:
            (tmp_path / "torn" / name).mkdir()
            (tmp_path / "torn" / name / "raw.tiff").write_bytes(bytes(size_bytes))
        assert store.torn() == dict.fromkeys(torn, size_bytes)
        store.keep(capture("new"), {"raw.tiff": bytes(1_000)})
        assert list(store.torn()) == [*torn[1:]]
        assert store.space_left() == 59  # 19,000 bytes and the 40,000 that would be given
        store.keep(capture("newer"), {"raw.tiff": bytes(40_000)})
        assert store.torn() == {}
        assert torn[0] in caplog.text
        with pytest.raises(StoreFull):
            store.keep(capture("too-much"), {"raw.tiff": bytes(30_000)})


def test_the_room_left_is_counted_in_captures_like_those_so_far(tmp_path: Path) -> None:
    free = [50_000_000]
    with Store(tmp_path, reserve_bytes=10_000_000, free_bytes=lambda folder: free[0]) as store:
        assert store.space_left() == 4  # by the estimate of ten million bytes
        store.keep(capture("a"), {"raw": bytes(1000), "png": bytes(200)})
        store.keep(capture("b"), {"raw": bytes(600)})
        assert store.space_left() == 40_000_000 // 900
        free[0] = 10_000_899
        assert store.space_left() == 0
        free[0] = 5
        assert store.space_left() == 0


def test_many_read_while_some_keep(store: Store) -> None:
    def keep(number: int) -> str:
        return store.keep(capture(f"{number:03}"), {"raw": bytes([number]) * 5000}).id

    def read(_: int) -> int:
        listed = store.captures()
        for kept in listed:
            assert store.read(kept.id, "raw") == bytes([int(kept.id)]) * 5000
        return len(listed)

    with ThreadPoolExecutor(12) as pool:
        kept, read_counts = pool.map(keep, range(16)), pool.map(read, range(30))
        assert len(set(kept)) == 16
        assert max(read_counts) <= 16
    assert sorted(one.id for one in store.captures()) == [f"{number:03}" for number in range(16)]


def test_two_openings_of_one_shelf_do_not_sweep_each_other(store: Store) -> None:
    """A second process may open the shelf while the first keeps."""

    def keep(number: int) -> None:
        store.keep(capture(f"{number:03}"), FILES)

    def reopen(_: int) -> tuple[str, ...]:
        with Store(store.folder, reserve_bytes=0) as other:
            return other.swept

    with ThreadPoolExecutor(4) as pool:
        kept, swept = pool.map(keep, range(15)), pool.map(reopen, range(15))
        assert list(kept) == [None] * 15
        assert list(swept) == [()] * 15
    assert len(store.captures()) == 15


def test_every_connection_is_durable_and_the_tables_are_strict(store: Store) -> None:
    engine = schema.open_engine(store.folder / "shelf.sqlite")
    with engine.connect() as one, engine.connect() as two:
        for connection in (one, two):
            for pragma, value in {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}.items():
                assert connection.exec_driver_sql(f"PRAGMA {pragma}").scalar() == value
            assert connection.exec_driver_sql("PRAGMA busy_timeout").scalar() >= 1000
        strict = {name: flag for name, flag in one.exec_driver_sql("SELECT name, strict FROM pragma_table_list")}  # noqa: C416
    engine.dispose()
    assert {strict[table.name] for table in schema.Shelf.metadata.sorted_tables} == {1}


def test_the_migrations_make_what_the_models_say(store: Store) -> None:
    engine = schema.open_engine(store.folder / "shelf.sqlite")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), schema.Shelf.metadata) == []
        made = set(
            connection.exec_driver_sql(
                "SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL AND name != 'alembic_version'"
            ).scalars()
        )
    engine.dispose()
    fresh = schema.open_engine(store.folder / "models.sqlite")
    with schema.for_writing(fresh).begin() as connection:
        schema.Shelf.metadata.create_all(connection)
        said = set(
            connection.exec_driver_sql(
                "SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL AND name != 'alembic_version'"
            ).scalars()
        )
    fresh.dispose()

    def words(statements: set[str]) -> list[list[str]]:
        parted = r",?\n|, (?=\w+ (?:TEXT|INTEGER|REAL|BLOB)\b)"  # an added column stands behind the last, on its line
        return sorted(sorted(part.strip(" \t,") for part in re.split(parted, sql)) for sql in statements)

    assert words(made) == words(said)  # checks and STRICT too, which Alembic does not compare


def test_a_shelf_of_a_newer_version_is_left_as_it_is(store: Store) -> None:
    store.keep(capture(), FILES)
    store.close()
    connection = database(store.folder)
    connection.execute("UPDATE alembic_version SET version_num = 'r9999'")
    connection.execute("ALTER TABLE captures ADD COLUMN added_later TEXT")
    connection.close()
    with Store(store.folder, reserve_bytes=0) as older:
        assert older.read(capture().id, "raw.tiff") == FILES["raw.tiff"]
        older.keep(capture("b"), FILES)
    connection = database(store.folder)
    assert connection.execute("SELECT version_num FROM alembic_version").fetchall() == [("r9999",)]
    connection.close()


@pytest.mark.parametrize(
    "change", ["eye = 'left'", "simulated = 2", "simulated = 'yes'", "report = '{'", "taken_at = NULL", "id = NULL"]
)
def test_the_table_itself_refuses_nonsense(store: Store, change: str) -> None:
    store.keep(capture(), FILES)
    connection = database(store.folder)
    with pytest.raises(sqlite3.IntegrityError):
        connection.execute(f"UPDATE captures SET {change}")
    connection.close()
