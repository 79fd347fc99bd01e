"""Data, keys, backups and logs are private with any umask; what a command writes where its user says follows it."""

import os
import stat
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from logging import getLogger
from pathlib import Path
from typing import Any

import pyrage
import pytest
from typer.testing import CliRunner

from device import atomic_io
from device.calibration.signing import create_key_pair
from device.clock import VirtualClock
from device.recon.model.fft_plans import Planner
from services.backup.backup_key import key_for_recipients
from services.backup.write_backup import write_backup
from services.delivery.usb_drives import copy_to_drive
from services.health.event_log import EventLog
from services.identity.audit_key import load_or_create_audit_key
from services.identity.lock_out import LockOut
from services.identity.provision import load_or_create_identity
from services.identity.users import UserTable
from services.identity.users_command import app as users_command
from services.records.audit_log import AuditLog
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.programme import load_programme
from services.records.snapshots import Snapshots
from services.records.visit_repository import VisitRepository

OTHER_USER_ID = 54_321
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


@pytest.fixture(params=[0o000, 0o022, 0o077], ids=oct)
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def modes(folder: Path) -> dict[str, str]:
    """Return the permission bits of a folder and of everything below it that are not private, by path."""
    found = {}
    for path in (folder, *folder.rglob("*")):
        expected = atomic_io.PRIVATE_FOLDER if path.is_dir() else atomic_io.PRIVATE_FILE
        if (mode := stat.S_IMODE(path.stat().st_mode)) != expected:
            found[str(path.relative_to(folder))] = oct(mode)
    return found


def test_a_data_folder_is_private_with_any_umask(umask: int, tmp_path: Path) -> None:
    """While it is open, too: the logs of the database have its rows."""
    data, clock = tmp_path / "data", VirtualClock()
    with CaptureStore(data, reserve_bytes=1) as store:
        visits = VisitRepository(store.engine, load_programme(), clock)
        visits.begin("0123456789abcdef")
        store.save(Capture("c", "OD", NOON, True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})
        DoseLedgerStore(store.engine, clock, 86_400.0, "boot")
        CaptureJournal(store).begin(InterruptedCapture("d", "OD"))
        Snapshots(data / "store.sqlite", clock).create("s0001")
        UserTable(data / "access").add("Asha", "274913", ["administrator"])
        LockOut(data / "access", clock).record_failure("Asha", "10.0.0.7")
        log = EventLog(data / "event-log")
        getLogger("services").info("an entry")
        log.close()
        (tmp_path / "stick").mkdir()
        write_backup(
            data,
            tmp_path / "stick",
            clock,
            lambda _, __: None,
            key_for_recipients([str(pyrage.x25519.Identity.generate().to_public())]),
        )
        Planner(data / "plans", effort="FFTW_MEASURE").plan((30, 42))
        assert (data / "store.sqlite-wal").exists()
        assert modes(data) == {}
    [backup] = (tmp_path / "stick").iterdir()
    assert modes(backup) == {}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_commands_of_root_leave_every_file_to_the_owner_of_the_data_folder(tmp_path: Path) -> None:
    data, clock = tmp_path / "data", VirtualClock()
    data.mkdir(0o700)
    os.chown(data, OTHER_USER_ID, OTHER_USER_ID)
    (tmp_path / "secret").write_text("274913")
    words = ["add", "Asha", "--role", "administrator", "--data", str(data), "--secret-file", str(tmp_path / "secret")]
    assert CliRunner().invoke(users_command, words).exit_code == 0
    key = load_or_create_audit_key(data)
    AuditLog(data, key, clock).append("", "copy", "c", by="command")
    with CaptureStore(data, reserve_bytes=1, key=key) as store:
        VisitRepository(store.engine, load_programme(), clock).begin("0123456789abcdef")
        store.save(Capture("c", "OD", NOON, True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})
        DoseLedgerStore(store.engine, clock, 86_400.0, "boot")
        assert (data / "store.sqlite-wal").exists()
        others = [str(path.relative_to(data)) for path in data.rglob("*") if path.stat().st_uid != OTHER_USER_ID]
    assert others == []


def test_an_identity_is_private_with_any_umask(umask: int, tmp_path: Path) -> None:
    load_or_create_identity(tmp_path / "data/identity", "10000000abcdef", VirtualClock())
    assert modes(tmp_path / "data") == {}


@pytest.mark.parametrize("mode", [0o755, 0o770, 0o2775])
def test_an_existing_data_folder_becomes_private(tmp_path: Path, mode: int) -> None:
    data = tmp_path / "data"
    data.mkdir()
    data.chmod(mode)
    tmp_path.chmod(0o755)
    CaptureStore(data, reserve_bytes=0).close()
    assert modes(data) == {}
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o755, "the folder around it stays as it is"


def test_a_database_that_others_could_read_becomes_private(tmp_path: Path) -> None:
    CaptureStore(tmp_path / "data", reserve_bytes=0).close()
    (tmp_path / "data/store.sqlite").chmod(0o644)
    CaptureStore(tmp_path / "data", reserve_bytes=0).close()
    assert modes(tmp_path / "data") == {}


WRITERS: dict[str, Callable[[Path], Any]] = {
    "public key": lambda folder: create_key_pair(folder / "key", "centre"),
    "stick": lambda folder: copy_to_drive(folder, "visit", {"a.png": b"a"}),
}


@pytest.mark.parametrize(("writer", "written"), [("public key", "key.pub"), ("stick", "visit/a.png")])
def test_what_a_user_names_follows_the_umask(umask: int, tmp_path: Path, writer: str, written: str) -> None:
    WRITERS[writer](tmp_path)
    assert stat.S_IMODE((tmp_path / written).stat().st_mode) == 0o666 & ~umask


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_a_file_that_root_opens_through_a_link_keeps_its_owner(tmp_path: Path) -> None:
    """Otherwise the user of the data folder could get any file of root by a link in it."""
    of_root, data = tmp_path / "shadow", tmp_path / "data"
    of_root.write_text("secret\n")
    data.mkdir()
    os.chown(data, OTHER_USER_ID, OTHER_USER_ID)
    (data / "log").symlink_to(of_root)
    with open(data / "log", "ab", opener=atomic_io.private_opener):
        pass
    with open(data / "new", "ab", opener=atomic_io.private_opener):
        pass
    assert (of_root.stat().st_uid, (data / "new").stat().st_uid) == (0, OTHER_USER_ID)
