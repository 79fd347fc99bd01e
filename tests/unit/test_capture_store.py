"""Capture store: storage, listing, quarantine, space limits and schema."""

import hashlib
import math
import re
import shutil
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from hypothesis import given, settings
from hypothesis import strategies as st

from device.errors import SettingError, StoreError, StoreFull
from device.values import Report
from services.errors import NO_FILES_REMEDY, RecordNotFound, StoreDamaged
from services.records import schema
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.quarantine import REQUIRED_FILES
from tests.golden.files import KEPT

MEMORY = Path("/dev/shm")  # order does not depend on the disk, and the test makes many stores
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
FILES = {"raw.tiff": b"raw" * 1000, "picture.png": b"", "report.json": b"{}"}
MORE_BYTES = len("diffuscope \n") + 12 + 16  # header, nonce and tag of an encrypted file of a test picture


def capture(name: str = "20260301T120000-OD-aa", taken_at: datetime = NOON, **report: object) -> Capture:
    return Capture(name, "OD", taken_at, True, "00ff", CaptureReport.read(report), {})


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "data" / "store", reserve_bytes=0) as opened:
        yield opened


def database(folder: Path) -> sqlite3.Connection:
    return sqlite3.connect(folder / "store.sqlite", isolation_level=None)


def test_a_stored_capture_is_equal_after_a_restart(store: CaptureStore) -> None:
    unsaved = capture(method="wiener", seconds={"solve": 0.25}, refraction_dpt=None)
    kept = store.save(unsaved, FILES)
    assert kept == unsaved.with_files({name: hashlib.sha256(content).hexdigest() for name, content in FILES.items()})
    store.close()
    with CaptureStore(store.folder) as again:
        assert again.newly_quarantined == ()
        assert again.captures() == [kept]
        assert again.get(kept.id) == kept
        assert {name: again.read(kept.id, name) for name in kept.files} == FILES


def test_a_timestamp_is_stored_in_utc(store: CaptureStore) -> None:
    there = NOON.astimezone(timezone(timedelta(hours=5, minutes=30)))
    store.save(capture(taken_at=there), FILES)
    assert store.get(capture().id).taken_at == NOON
    assert store.get(capture().id).taken_at.utcoffset() == timedelta(0)
    with pytest.raises(SettingError, match="no time zone"):
        store.save(capture("b", NOON.replace(tzinfo=None)), FILES)


def test_numbers_of_a_report_that_json_does_not_have_become_null(store: CaptureStore) -> None:
    made = Report("wiener", residual=float("nan"), noise_dn=np.float32(1.5), warnings=("dim",), quality={"a": [np.inf]})
    store.save(replace(capture(), report=CaptureReport(**vars(made))), FILES)
    kept = store.get(capture().id).report
    assert kept == CaptureReport(**vars(made) | {"residual": None, "quality": {"a": [None]}})
    with pytest.raises(SettingError, match="cannot be written down"):
        store.save(capture("b", at=object()), FILES)
    assert [path.name for path in (store.folder / "captures").iterdir()] == [capture().id]


moments = st.datetimes(datetime(2020, 1, 1), datetime(2020, 1, 1, 0, 0, 3), timezones=st.timezones())


@given(st.lists(moments, max_size=7), st.integers(1, 3))
@settings(max_examples=12, deadline=None)
def test_the_list_is_newest_first_and_its_pages_have_no_gap(taken: list[datetime], page: int) -> None:
    with (
        TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder,
        CaptureStore(Path(folder), reserve_bytes=0) as store,
    ):
        for number, moment in enumerate(taken):
            store.save(capture(f"{number}", moment), {"a": b"1"})
        expected = [
            f"{n}" for n in reversed(range(len(taken)))
        ]  # order of storage: the clock may be set back meanwhile
        assert [kept.id for kept in store.captures()] == expected
        paged: list[str] = []
        while part := store.captures(page, before=paged[-1] if paged else None):
            assert len(part) <= page
            paged += [kept.id for kept in part]
        assert paged == expected


def test_a_list_needs_a_positive_limit_and_a_known_start(store: CaptureStore) -> None:
    with pytest.raises(SettingError):
        store.captures(0)
    with pytest.raises(RecordNotFound):
        store.captures(before="never")


@pytest.mark.parametrize("id", ["never", "", "../store.sqlite", "a/b", "\0", "\ud800", "x" * 300])
def test_an_unknown_id_is_not_kept(store: CaptureStore, id: str) -> None:
    with pytest.raises(RecordNotFound):
        store.get(id)
    with pytest.raises(RecordNotFound):
        store.read(id, "raw.tiff")


@pytest.mark.parametrize(
    "name", ["../x/raw.tiff", "/etc/passwd", "..", "", "RAW.TIFF", "other", "./raw.tiff", "\ud800"]
)
def test_a_file_name_cannot_escape_the_folder_of_a_capture(store: CaptureStore, name: str) -> None:
    store.save(capture(), FILES)
    with pytest.raises(RecordNotFound, match="no file"):
        store.read(capture().id, name)


@pytest.mark.parametrize("name", ["..", ".hidden", "a/b", "", "-x", "a\n", "\ud800", "ü"])
def test_invalid_names_are_refused_before_any_write(store: CaptureStore, name: str) -> None:
    with pytest.raises(SettingError, match="cannot name"):
        store.save(capture(name), FILES)
    with pytest.raises(SettingError, match="cannot name"):
        store.save(capture(), {name: b"1"})
    with pytest.raises(SettingError, match="nothing to keep"):
        store.save(capture(), {})
    assert list((store.folder / "captures").iterdir()) == []


def test_a_second_capture_with_the_same_id_is_refused_and_the_first_stays(store: CaptureStore) -> None:
    store.save(capture(), FILES)
    with pytest.raises(StoreError, match="already"):
        store.save(capture(), {"raw.tiff": b"other"})
    assert store.read(capture().id, "raw.tiff") == FILES["raw.tiff"]


def test_a_flipped_bit_fails_the_checksum(store: CaptureStore) -> None:
    store.save(capture(), FILES)
    path = store.folder / "captures" / capture().id / "raw.tiff"
    content = bytearray(path.read_bytes())
    content[1234] ^= 1
    path.write_bytes(content)
    with pytest.raises(StoreDamaged, match=r"raw\.tiff of .* cannot be decrypted"):
        store.read(capture().id, "raw.tiff")
    assert store.read(capture().id, "report.json") == b"{}"
    path.unlink()
    with pytest.raises(StoreDamaged, match="cannot be read"):
        store.read(capture().id, "raw.tiff")


def test_a_row_without_its_folder_is_listed_and_reported_as_damaged(store: CaptureStore) -> None:
    store.save(capture("a"), FILES)
    store.save(capture("b", NOON + timedelta(seconds=1)), FILES)
    shutil.rmtree(store.folder / "captures" / "a")
    store.close()
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert [kept.id for kept in again.captures()] == ["b", "a"]
        with pytest.raises(StoreDamaged, match="gone"):
            again.get("a")
        with pytest.raises(StoreDamaged):
            again.read("a", "raw.tiff")
        assert again.get("b").id == "b"


def test_an_incomplete_capture_is_quarantined_and_overwrites_no_other(store: CaptureStore) -> None:
    store.save(capture("kept"), FILES)
    store.close()
    for name in (".torn.part", "torn", "renamed"):
        (store.folder / "captures" / name).mkdir()
        (store.folder / "captures" / name / "raw.tiff").write_bytes(name.encode())
    (store.folder / "captures" / "note").write_bytes(b"a file that is none of ours stays")
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.newly_quarantined == ("torn", "renamed", "torn-2")
        assert [kept.id for kept in again.captures()] == ["kept"]
        found = {path.parent.name: path.read_bytes() for path in (store.folder / "quarantine").glob("*/*")}
        assert found == {"torn": b".torn.part", "torn-2": b"torn", "renamed": b"renamed"}
        assert again.read("kept", "raw.tiff") == FILES["raw.tiff"]
    with CaptureStore(store.folder) as once_more:
        assert once_more.newly_quarantined == ()


def test_a_complete_capture_that_was_not_renamed_is_quarantined_and_listed_as_orphan(store: CaptureStore) -> None:
    """The process was killed between the last file and the rename: no row exists, and no file is lost."""
    store.close()
    part = store.folder / "captures" / ".whole.part"
    part.mkdir()
    for name in REQUIRED_FILES:
        (part / name).write_bytes(b"content")
    with CaptureStore(store.folder, reserve_bytes=0) as again:
        assert again.newly_quarantined == ("whole",)
        assert again.quarantine.orphans() == ["whole"]
        assert again.quarantine.sizes_bytes() == {}
        assert {path.name for path in (store.folder / "quarantine" / "whole").iterdir()} == REQUIRED_FILES


@pytest.mark.parametrize("leave", ["nothing", "an empty file"])
def test_a_missing_database_of_a_store_without_files_of_visits_is_an_error(store: CaptureStore, leave: str) -> None:
    store.save(capture(), FILES)
    store.close()
    (store.folder / "visits").rmdir()
    (store.folder / "store.sqlite").unlink()
    if leave == "an empty file":
        (store.folder / "store.sqlite").touch()
    with pytest.raises(StoreDamaged, match="is gone"):
        CaptureStore(store.folder)
    assert (store.folder / "captures" / capture().id / "raw.tiff").exists()


def test_a_file_that_is_no_database_is_an_error_without_files_of_visits(store: CaptureStore) -> None:
    store.close()
    (store.folder / "visits").rmdir()
    (store.folder / "store.sqlite").write_bytes(b"not a database at all" * 1000)
    with pytest.raises(StoreDamaged, match="not a database"):
        CaptureStore(store.folder)


def test_a_missing_disk_is_a_store_error(store: CaptureStore) -> None:
    shutil.rmtree(store.folder / "captures")
    with pytest.raises(StoreError, match="disk refused") as raised:
        store.save(capture(), FILES)
    assert not isinstance(raised.value, StoreFull)
    assert store.captures() == []


def test_too_little_space_is_refused_before_any_write(tmp_path: Path) -> None:
    need = sum(len(content) + MORE_BYTES for content in FILES.values())
    free = [1000 + need]
    with CaptureStore(tmp_path, reserve_bytes=1000, free_bytes=lambda folder: free[0]) as store:
        store.save(capture("fits"), FILES)
        free[0] -= 1
        with pytest.raises(StoreFull, match="reserve"):
            store.save(capture("does-not"), FILES)
        assert [path.name for path in (tmp_path / "captures").iterdir()] == ["fits"]


def test_quarantined_captures_are_deleted_oldest_first_when_a_new_one_needs_space(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No quarantined capture is deleted earlier, whatever its age; quarantined bytes count as free space."""
    size_bytes, quarantined = 20_000, ("20260301T120000-OD-aa", "20260301T120100-OD-bb", "20260301T120200-OD-cc")

    def free_bytes(folder: Path) -> int:
        return 60_000 - sum(path.stat().st_size for path in folder.rglob("*/*/*"))

    with CaptureStore(tmp_path, reserve_bytes=0, free_bytes=free_bytes) as store:
        for name in quarantined:
            (tmp_path / "quarantine" / name).mkdir()
            (tmp_path / "quarantine" / name / "raw.tiff").write_bytes(bytes(size_bytes))
        assert store.quarantine.sizes_bytes() == dict.fromkeys(quarantined, size_bytes)
        store.save(capture("new"), {"raw.tiff": bytes(1_000 - MORE_BYTES)})
        assert list(store.quarantine.sizes_bytes()) == [*quarantined[1:]]
        assert store.space.captures_left() == 58  # 19,000 free bytes less a record, and 40,000 quarantined ones
        store.save(capture("newer"), {"raw.tiff": bytes(40_000)})
        assert store.quarantine.sizes_bytes() == {}
        assert quarantined[0] in caplog.text
        with pytest.raises(StoreFull):
            store.save(capture("too-much"), {"raw.tiff": bytes(30_000)})


def test_the_free_space_is_counted_in_captures_of_mean_size(tmp_path: Path) -> None:
    free = [50_000_000]
    with CaptureStore(tmp_path, reserve_bytes=10_000_000, free_bytes=lambda folder: free[0]) as store:
        assert store.space.captures_left() == 4  # by the default size of ten million bytes
        store.save(capture("a"), {"raw": bytes(1000 - MORE_BYTES), "png": bytes(200 - MORE_BYTES)})
        store.save(capture("b"), {"raw": bytes(600 - MORE_BYTES)})
        assert store.space.captures_left() == 40_000_000 // 900
        free[0] = 10_000_899
        assert store.space.captures_left() == 0
        free[0] = 5
        assert store.space.captures_left() == 0


def test_free_files_are_counted_in_captures(tmp_path: Path) -> None:
    """A capture of two files takes four with its folder and its record; 16 files and those of one press stay free."""
    free = [math.inf]
    with CaptureStore(tmp_path, reserve_bytes=0, free_bytes=lambda _: 10**9, free_files=lambda _: free[0]) as store:
        store.save(capture("a"), {"raw": bytes(1000 - MORE_BYTES), "png": bytes(200 - MORE_BYTES)})
        assert (store.space.captures_left(), store.space.lacks_files()) == (10**9 // 1200, False)
        free[0] = 16 + 8 + 3 * 4
        assert (store.space.captures_left(), store.space.lacks_files()) == (4, True)
        free[0] = 16 + 8 - 1
        assert store.space.captures_left() == 0


def test_a_press_without_free_files_is_refused_before_the_light(tmp_path: Path) -> None:
    free = [1000.0]
    with CaptureStore(tmp_path, reserve_bytes=0, free_files=lambda _: free[0]) as store:
        store.refuse_light_in_vain()
        free[0] = 10
        with pytest.raises(StoreFull, match="files") as raised:
            store.refuse_light_in_vain()
        assert raised.value.remedy == NO_FILES_REMEDY
        free[0] = 2
        with pytest.raises(StoreFull, match="files"):
            store.save(capture("a"), FILES)


def test_a_press_without_free_files_deletes_quarantined_captures(tmp_path: Path) -> None:
    def free_files(_: Path) -> float:
        return 60 - sum(1 for _ in tmp_path.rglob("quarantine/*/*"))

    with CaptureStore(tmp_path, reserve_bytes=0, free_files=free_files) as store:
        (tmp_path / "quarantine/20260301T120000-OD-aa").mkdir()
        for number in range(50):
            (tmp_path / f"quarantine/20260301T120000-OD-aa/{number}").touch()
        store.refuse_light_in_vain()
        assert store.quarantine.sizes_bytes() == {}


def test_concurrent_reads_and_writes(store: CaptureStore) -> None:
    def keep(number: int) -> str:
        return store.save(capture(f"{number:03}"), {"raw": bytes([number]) * 5000}).id

    def read(_: int) -> int:
        listed = store.captures()
        for kept in listed:
            assert store.read(kept.id, "raw") == bytes([int(kept.id)]) * 5000
        return len(listed)

    with ThreadPoolExecutor(12) as pool:
        kept, read_counts = pool.map(keep, range(16)), pool.map(read, range(30))
        assert len(set(kept)) == 16
        assert max(read_counts) <= 16
    assert sorted(record.id for record in store.captures()) == [f"{number:03}" for number in range(16)]


def test_an_opening_does_not_quarantine_a_capture_that_is_being_written(store: CaptureStore) -> None:
    """A second process may open the store while the first writes."""

    def keep(number: int) -> None:
        store.save(capture(f"{number:03}"), FILES)

    def reopen(_: int) -> tuple[str, ...]:
        with CaptureStore(store.folder, reserve_bytes=0) as other:
            return other.newly_quarantined

    with ThreadPoolExecutor(4) as pool:
        kept, recovered = pool.map(keep, range(15)), pool.map(reopen, range(15))
        assert list(kept) == [None] * 15
        assert list(recovered) == [()] * 15
    assert len(store.captures()) == 15


def test_every_connection_is_durable_and_the_tables_are_strict(store: CaptureStore) -> None:
    engine = schema.open_engine(store.folder / "store.sqlite")
    with engine.connect() as first, engine.connect() as second:
        for connection in (first, second):
            for pragma, value in {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}.items():
                assert connection.exec_driver_sql(f"PRAGMA {pragma}").scalar() == value
            assert connection.exec_driver_sql("PRAGMA busy_timeout").scalar() >= 1000
        rows = first.exec_driver_sql("SELECT name, strict FROM pragma_table_list")
        strict = {row.name: row.strict for row in rows}
    engine.dispose()
    assert {strict[table.name] for table in schema.Base.metadata.sorted_tables} == {1}


# The models declare no trigger; test_migrations.py checks what a trigger may do.
TABLES_AND_INDEXES = (
    "SELECT sql FROM sqlite_schema WHERE type IN ('table', 'index') AND sql IS NOT NULL AND name != 'alembic_version'"
)


def test_the_migrations_lead_to_the_schema_of_the_models(tmp_path: Path) -> None:
    engine = schema.open_engine(Path(shutil.copy(KEPT / "data" / schema.DATABASE, tmp_path)))
    schema.migrate(engine, lambda _: None)
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), schema.Base.metadata) == []
        made = set(connection.exec_driver_sql(TABLES_AND_INDEXES).scalars())
    engine.dispose()
    fresh = schema.open_engine(tmp_path / "models.sqlite")
    with schema.for_writing(fresh).begin() as connection:
        schema.Base.metadata.create_all(connection)
        declared = set(connection.exec_driver_sql(TABLES_AND_INDEXES).scalars())
    fresh.dispose()

    def words(statements: set[str]) -> list[list[str]]:
        parted = r",?\n|, (?=\w+ (?:TEXT|INTEGER|REAL|BLOB)\b)"  # SQLite appends an added column to the last line
        return sorted(sorted(part.strip(" \t,") for part in re.split(parted, sql)) for sql in statements)

    assert words(made) == words(declared)  # includes CHECK and STRICT, which Alembic does not compare


def test_tables_of_a_newer_schema_stay_unchanged(store: CaptureStore) -> None:
    store.save(capture(), FILES)
    store.close()
    connection = database(store.folder)
    connection.execute("UPDATE alembic_version SET version_num = 's9999'")
    connection.execute("ALTER TABLE captures ADD COLUMN added_later TEXT")
    checksum = schema.schema_checksum(connection.execute(schema.SCHEMA_TEXT).fetchall())
    connection.execute(f"PRAGMA user_version = {checksum}")
    connection.close()
    with CaptureStore(store.folder, reserve_bytes=0) as older:
        assert older.read(capture().id, "raw.tiff") == FILES["raw.tiff"]
        older.save(capture("b"), FILES)
    connection = database(store.folder)
    assert connection.execute("SELECT version_num FROM alembic_version").fetchall() == [("s9999",)]
    connection.close()


@pytest.mark.parametrize(
    "change", ["eye = 'left'", "simulated = 2", "simulated = 'yes'", "report = '{'", "taken_at = NULL", "id = NULL"]
)
def test_the_constraints_of_the_table_refuse_invalid_values(store: CaptureStore, change: str) -> None:
    store.save(capture(), FILES)
    connection = database(store.folder)
    with pytest.raises(sqlite3.IntegrityError):
        connection.execute(f"UPDATE captures SET {change}")
    connection.close()
