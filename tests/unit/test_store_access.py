"""A store that belongs to another user, and two programs on one store."""

import encodings.utf_8_sig  # noqa: F401  # another user may not be able to load it later
import multiprocessing
import os
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from device.clock import VirtualClock
from device.errors import StoreError, StoreReadOnly
from services.errors import StoreLocked
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.read_only_store import opened_store
from services.records.visit_repository import VisitRepository
from tests.project_files import ROOT

OTHER_USER_ID = 65534  # has no rights on any file
FILES = {"raw.tiff": b"raw", "picture.png": b"picture", "report.json": b"{}", "quick.jpg": b"", "dark.tiff": b"d"}
ADDED = 10
WRITER = """
import sys
from pathlib import Path
from tests.unit.test_store_access import add_captures
add_captures(Path(sys.argv[1]), sys.argv[2])
"""


def add_captures(folder: Path, name: str) -> None:
    """Store ADDED captures; what another process does."""
    with CaptureStore(folder, reserve_bytes=0) as store:
        for number in range(ADDED):
            store.save(capture(f"{name}-{number}"), FILES)


def capture(id: str) -> Capture:
    return Capture(id, "OD", datetime(2026, 3, 1, tzinfo=UTC), True, "00ff", CaptureReport(), {})


@pytest.fixture
def folder() -> Iterator[Path]:
    """A store with one capture, below a folder that every user can enter."""
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        with CaptureStore(Path(place) / "store", reserve_bytes=0) as store:
            store.save(capture("mine"), FILES)
        yield Path(place) / "store"


def run_as(user_id: int, act: Callable[[], None]) -> int | None:
    """Run `act` as another user in a forked process, whose modules are loaded already; return its exit status."""

    def run() -> None:
        os.setgroups([])
        os.setgid(user_id)
        os.setuid(user_id)
        act()

    child = multiprocessing.get_context("fork").Process(target=run)
    child.start()
    child.join()
    return child.exitcode


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
@pytest.mark.filterwarnings("ignore:This process.*fork:DeprecationWarning")  # the child starts no thread
@pytest.mark.parametrize(("folder_mode", "database_mode"), [(0o700, 0o600), (0o755, 0o644), (0o777, 0o444)])
def test_a_store_of_another_user_is_a_clear_error_and_stays_as_it_was(
    folder: Path, folder_mode: int, database_mode: int
) -> None:
    folder.chmod(folder_mode)
    (folder / "store.sqlite").chmod(database_mode)
    before = {path: path.is_file() and path.read_bytes() for path in sorted(folder.rglob("*"))}

    def open_it() -> None:
        with pytest.raises(StoreError, match=r"refused: .*([Pp]ermission|readonly|open)|other users may"):
            CaptureStore(folder, reserve_bytes=0)

    assert run_as(OTHER_USER_ID, open_it) == 0
    after = {path: path.is_file() and path.read_bytes() for path in sorted(folder.rglob("*"))}
    assert {path: after.get(path) for path in before} == before
    folder.chmod(0o700)
    with CaptureStore(folder, reserve_bytes=0) as store:
        assert store.read("mine", "raw.tiff") == FILES["raw.tiff"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
@pytest.mark.filterwarnings("ignore:This process.*fork:DeprecationWarning")  # the child starts no thread
def test_a_store_that_may_only_be_read_is_shown_and_takes_nothing(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)

    def read() -> None:
        with opened_store(folder, VirtualClock()) as store:
            assert store.read("mine", "raw.tiff") == FILES["raw.tiff"]
            with pytest.raises(StoreReadOnly, match="ermission"):
                store.save(capture("other"), FILES)
            with pytest.raises(StoreReadOnly):
                store.refuse_light_in_vain()
            ledger = DoseLedgerStore(store.engine, VirtualClock(), 86_400.0, "boot")
            with pytest.raises(StoreReadOnly):
                ledger.reserve(("OD",), 0.0, 1.0)
            people = VisitRepository(store.engine, load_programme(), VirtualClock())
            with pytest.raises(StoreReadOnly):
                people.begin("0123456789abcdef")

    assert run_as(OTHER_USER_ID, read) == 0
    with opened_store(folder, VirtualClock()) as store:
        assert [record.id for record in store.captures()] == ["mine"]
        assert store.refusal is None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
@pytest.mark.filterwarnings("ignore:This process.*fork:DeprecationWarning")  # the child starts no thread
def test_a_folder_of_another_user_that_all_may_write_is_refused() -> None:
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o777)

        def open_it() -> None:
            with pytest.raises(StoreError, match="other users may read") as raised:
                CaptureStore(Path(place), reserve_bytes=0)
            assert "--data" in raised.value.remedy
            assert not isinstance(raised.value, StoreReadOnly)

        assert run_as(OTHER_USER_ID, open_it) == 0
        assert list(Path(place).iterdir()) == []


def test_an_error_that_is_not_of_the_disk_does_not_open_the_store_for_reading(folder: Path) -> None:
    (folder / ".lock").unlink()
    (folder / ".lock").mkdir()
    with pytest.raises(StoreError, match="directory"), opened_store(folder, VirtualClock()):
        pytest.fail("it opened")


def test_two_programs_on_one_store_lose_nothing(folder: Path) -> None:
    """The lock of the store serialises writers, and an opening does not take a capture being written for a torn one."""
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(folder), name], cwd=ROOT) for name in ("first", "second")
    ]
    assert [writer.wait(120) for writer in writers] == [0, 0]
    with CaptureStore(folder, reserve_bytes=0) as store:
        expected = {"mine", *(f"{name}-{number}" for name in ("first", "second") for number in range(ADDED))}
        assert {record.id for record in store.captures()} == expected
        assert all(store.read(capture_id, name) == FILES[name] for capture_id in expected for name in FILES)
        assert store.newly_quarantined == ()


@pytest.fixture
def locked(folder: Path) -> Iterator[CaptureStore]:
    """A store on whose database another connection holds the write lock."""
    with CaptureStore(folder, reserve_bytes=0) as store, closing(sqlite3.connect(folder / "store.sqlite")) as other:
        other.execute("BEGIN IMMEDIATE")
        yield store
        other.execute("ROLLBACK")


def test_a_locked_database_is_found_by_the_health_check(locked: CaptureStore) -> None:
    with pytest.raises(StoreLocked, match="locked"):
        locked.check_writable()


def test_a_locked_database_refuses_the_light_with_its_own_remedy(tmp_path: Path) -> None:
    """Not "free some space": what helps is to close the other program."""
    with CaptureStore(tmp_path, reserve_bytes=0) as store, closing(sqlite3.connect(tmp_path / "store.sqlite")) as other:
        ledger = DoseLedgerStore(store.engine, VirtualClock(), 86_400.0, "boot")
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreLocked) as raised:
            ledger.reserve(("OD",), 0.0, 1.0)
        assert "close it" in raised.value.remedy
        other.execute("ROLLBACK")
        ledger.reserve(("OD",), 0.0, 1.0)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
@pytest.mark.filterwarnings("ignore:This process.*fork:DeprecationWarning")  # the child starts no thread
@pytest.mark.parametrize("name", [".", "captures"])
def test_a_folder_that_becomes_read_only_refuses_the_light(folder: Path, name: str) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o777)

    def use() -> None:
        with CaptureStore(folder, reserve_bytes=0) as store:
            store.refuse_light_in_vain()
            (folder / name).chmod(0o555)
            with pytest.raises(StoreReadOnly):
                store.refuse_light_in_vain()
            with pytest.raises(StoreReadOnly):
                store.check_writable()

    for path in (folder, *folder.rglob("*")):
        os.chown(path, OTHER_USER_ID, OTHER_USER_ID)
    assert run_as(OTHER_USER_ID, use) == 0
