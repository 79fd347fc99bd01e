"""Capture store: atomic and durable storage of captures, even across a kill, a power cut or a full disk.

    store.sqlite                  database: one row per stored capture; also visits and the dose ledger
    store.sqlite-wal              write-ahead log: rows that are not in the main file yet (write_ahead_log.py)
    captures/<id>/<name>          files of each capture, encrypted under the key of its patient (blobs.py)
    captures/<id>/record.json     what the rows of the capture hold (record_document.py)
    patients/<id>.json            what the rows of a patient hold
    visits/<id>.json              what the rows of a visit hold
    damaged/<n>/                  databases that could not be used and were rebuilt from these files (recovery.py)
    conflicts/                    states of records that another state replaced after a rollback (recovery.py)
    captures/.<id>.part/          capture being written; no row yet
    removed/                      files that were removed to make room (removed_captures.py)
    quarantine/<id>/              captures found incomplete at an opening of the store; not listed, kept until their
                                  space is needed (quarantine.py)
    snapshots/                    copies of the tables before each migration (snapshots.py)
    journal/                      captures in progress and their frames (capture_journal.py)
    dose-ledger.log               second copy of the dose ledger (dose_ledger_log.py)
    exports/<visit>.json          copies on USB drives (export_records.py)
    device.json                   identity of the device (device_identity.py)
    reserve.bin                   space for records on a full disk (reserve_file.py)
    replaced/                     what a restored backup replaced (restoration.py)
    record-key-id                 name of the key of the records' files (record_files.py)
    patient-keys, patient-keys-copy  keys of the patients, two copies (patient_keys.py)
    .lock                         lock of the commands that change the folder

Commit protocol: files, fsync, atomic rename of the folder, and then the row. A new row therefore has its
files; large ones may be removed later to make room (removed_captures.py). A folder that has all files of a capture and
no row may have lost its row: the next opening restores the row from the record in the folder (recovery.py). Without a
valid record the store neither moves nor removes it, and `Quarantine.orphans` lists it.
"""

import hashlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from sqlalchemy import func, select
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from device import atomic_io
from device.clock import Clock, SystemClock
from device.errors import SettingError, StoreError, StoreReadOnly
from device.user_files import files_in
from services.errors import RecordNotFound, RecordRemoved, StoreDamaged
from services.records import blobs, capture_rows, patient_rows, row_validation, schema
from services.records.blobs import FileContent
from services.records.capture import Capture
from services.records.capture_target import RowWriter
from services.records.capture_versions import CaptureVersions
from services.records.earlier_stores import refuse_earlier_store
from services.records.patient_keys import PatientKeys
from services.records.patient_rows import PatientIndex
from services.records.quarantine import Quarantine
from services.records.record_document import RecordDocument
from services.records.record_files import CAPTURE_RECORD, RecordFiles
from services.records.record_rows import capture_content, file_entries
from services.records.record_signing import PAGE_ROWS, recorded, write_signature
from services.records.recovery import Recovery, damage_of, set_aside
from services.records.recovery_report import RecoveryReport
from services.records.removed_captures import RemovedCaptures, is_large
from services.records.reserve_file import ReserveFile
from services.records.restoration import finish_restoration
from services.records.row_validation import REMEDY
from services.records.schema import CaptureRow
from services.records.snapshots import Snapshots
from services.records.storage_errors import is_disk_full, is_locked, storage_errors
from services.records.store_space import FreeSpace, StoreSpace
from services.records.write_ahead_log import WriteAheadLog

log = logging.getLogger(__name__)


class CaptureStore:
    """Store of captures in one folder; opening it migrates the tables and moves incomplete captures to quarantine.

    `newly_quarantined` holds the names in `quarantine/` of the folders moved there at this opening, `recovery` what was
    restored from the files of the records. With `refusal` the folder is a copy in memory (read_only_store.py): nothing
    is recovered or quarantined, and every change raises this error. `key` authenticates the files of records and dose
    ledger: nothing is restored from one that another program wrote; None checks none. It also wraps `keys`, those of
    the patients. `quarantine`, `versions`, `space` and `write_ahead_log` are the parts of the store for those matters.
    Several threads may read while one writes; a lock file serialises writers across threads and processes. Opening and
    closing checkpoint the write-ahead log. Errors at opening: StoreError, StoreFull, StoreDamaged.
    """

    newly_quarantined: tuple[str, ...]
    recovery: RecoveryReport

    def __init__(
        self,
        folder: Path,
        *,
        reserve_bytes: int = atomic_io.RESERVE_BYTES,
        free_bytes: Callable[[Path], int] = atomic_io.free_bytes,
        free_files: Callable[[Path], float] = atomic_io.free_files,
        clock: Clock | None = None,
        refusal: StoreError | None = None,
        key: bytes | None = None,
    ) -> None:
        self.folder, self.refusal = folder, refusal
        self._captures = folder / "captures"
        self._lock = folder / ".lock"
        database = folder / schema.DATABASE
        quarantine = folder / "quarantine"
        with storage_errors(), ExitStack() as cleanup:
            refuse_earlier_store(database)
            _make_private(folder)
            atomic_io.make_folder(self._captures)
            atomic_io.make_folder(quarantine)
            snapshots = Snapshots(database, clock or SystemClock(), free_bytes)
            self.engine = schema.open_engine(database, key)  # connects later
            cleanup.callback(self.engine.dispose)
            self.write_ahead_log = WriteAheadLog(database, self.engine)
            self.quarantine = Quarantine(self._captures, quarantine, self._lock, self.engine)
            self.removed = RemovedCaptures(self._captures, folder / "removed", self._lock)
            free = FreeSpace(folder, free_bytes, free_files)
            self.space = StoreSpace(free, self.engine, (self.removed, self.quarantine), reserve_bytes)
            with atomic_io.file_lock(self._lock):  # a capture that another process is writing is not incomplete
                finish_restoration(folder)
                self.keys = PatientKeys(folder, key)
                self.engine.update_execution_options(patients=PatientIndex(self.keys))
                self.versions = CaptureVersions(self._captures, self._lock, self.engine, self.keys)
                damage = self._set_damaged_database_aside()
                schema.make_private(database)
                schema.migrate(self.engine, snapshots.create)
                if refusal is None:
                    self.recovery = Recovery(folder, self.engine, damage).run()
                    self.newly_quarantined = self.quarantine.move_incomplete()
                    self.write_ahead_log.checkpoint_if_possible()
                    ReserveFile(folder).allocate_if_room(reserve_bytes, free_bytes(folder))
                else:
                    self.recovery = RecoveryReport(rebuilt_because=damage)
                    self.newly_quarantined = ()
                    schema.refuse_changes(self.engine, refusal)
            cleanup.pop_all()

    def close(self) -> None:
        """Checkpoint the write-ahead log, if the disk permits, and close the database connections."""
        self.write_ahead_log.checkpoint_if_possible()
        self.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def save(
        self,
        capture: Capture,
        files: Mapping[str, FileContent],
        write_rows: RowWriter | None = None,
        request: str | None = None,
    ) -> Capture:
        """Store a capture and its files (name -> plain content); return it with their SHA-256 once it is durable.

        `write_rows` adds rows in the same transaction. `request`: reference of the press, as
        `IdempotentRequests.reference` returns it, stored in the record of the capture. Quarantined captures are deleted
        if their space is needed; files that are on the disk already are linked, the others are encrypted.
        Errors: StoreFull, StoreLocked (everything written is removed); StoreReadOnly; StoreError (the id exists; or a
        write failed: the next opening quarantines the folder if it is incomplete and has no row); SettingError (invalid
        id, file name or report, or no files); RecordNotFound (unknown visit).
        """
        _refuse_names(capture.id, files)
        capture = capture.with_files({name: _sha256(content) for name, content in files.items()})
        patient_id = patient_rows.patient_of_visit(self.engine, capture.report.visit)
        files = {
            name: blobs.encrypted(self.keys, patient_id, content) if isinstance(content, bytes) else content
            for name, content in files.items()
        }
        row = schema.row_of(capture, {name: _length_bytes(content) for name, content in files.items()})
        row.request = request
        record = RecordDocument("capture", 1, capture_content(row, file_entries(row)))
        length_bytes = sum(map(_length_bytes, files.values()))  # rows and record, some kilobytes, fit into the reserve
        new_bytes = sum(len(content) for content in files.values() if isinstance(content, bytes))
        files = {**files, CAPTURE_RECORD: record.encoded(schema.key_of(self.engine))}
        part = self._captures / f".{capture.id}.part"
        kept = self._captures / capture.id
        with storage_errors(), atomic_io.file_lock(self._lock):
            self._refuse_duplicate(part, kept)
            schema.refuse_if_read_only(self.engine)
            self.space.make_room(new_bytes, len(files) + 1)
            with _removed_when_refused(part, kept):
                blobs.write_folder(part, files)
                atomic_io.replace_durably(part, kept)
                with _renamed_back_when_refused(kept, part), recorded(self.engine) as session:
                    session.add(row)
                    session.flush()
                    write_signature(session, record)
                    if write_rows is not None:
                        write_rows(session, capture)
        self.space.count_capture(length_bytes, len(capture.files))
        return capture

    def captures(self, limit: int = 50, before: str | None = None) -> list[Capture]:
        """Return the newest captures, newest first; with `before`, those stored before the capture with that id.

        The order is the order of storage (row number), independent of the clock. Captures whose row cannot be read are
        omitted. At most `limit` captures. Errors: SettingError (limit below 1), RecordNotFound (`before` is unknown),
        StoreDamaged (the database or the row of `before` is damaged).
        """
        if limit < 1:
            raise SettingError(f"a list of {limit} captures is not a list", "Ask for one capture or more.")
        out: list[Capture] = []
        with self._reading() as session:
            for page in capture_rows.pages(session, limit, None if before is None else _row(session, before).kept):
                out += page.captures
                if len(out) >= limit:
                    break
        return out[:limit]

    def damaged(self) -> int:
        """Return the number of captures whose row cannot be read.

        Lists omit these captures, and `get` raises StoreDamaged.
        """
        with self._reading() as session:
            return sum(len(page.damaged) for page in capture_rows.pages(session, PAGE_ROWS))

    def first_taken_after(self, moment: datetime | None) -> datetime | None:
        """Return the time of the first capture after a moment, or of the first of all; None without one.

        StoreDamaged if the database is damaged. An unreadable time counts as none.
        """
        query = select(func.min(CaptureRow.taken_at))
        if moment is not None:
            query = query.where(CaptureRow.taken_at > schema.utc_text(moment))
        with self._reading() as session:
            first = session.scalar(query)
        try:
            return None if first is None else row_validation.timestamp(first)
        except ValueError:
            return None

    def get(self, id: str) -> Capture:
        """Return the capture with that id; its files are not checked.

        RecordNotFound if unknown, StoreDamaged if its row cannot be read or its folder is missing.
        """
        with self._reading() as session:
            row = _row(session, id)
            capture = capture_rows.capture_of(row, capture_rows.files_of(session, [row]))
        if not (self._captures / capture.id).is_dir():
            raise StoreDamaged(f"the folder of {capture.id} is gone")
        return capture

    def read(self, id: str, name: str) -> bytes:
        """Return the plain content of one file of a capture after a SHA-256 check.

        RecordNotFound for an unknown capture or file, RecordRemoved for a removed file, RecordErased for one of an
        erased patient, StoreDamaged if the file is unreadable or has changed.
        """
        with self._reading() as session:
            row = _row(session, id)
            files = {name: digest for name, digest, _ in capture_rows.files_of(session, [row]).get(row.id, ())}
        if name not in files:
            raise RecordNotFound(f"{id} has no file named {name!r}")
        # The path is built from the row alone: path traversal through `id` or `name` is impossible.
        try:
            content = blobs.read_file(self._captures / row.id / name, self.keys)
        except OSError as error:
            if (removal := self.removed.removal(row.id)) is not None and is_large(name):
                when = f"{removal.removed_at:%Y-%m-%d}"
                raise RecordRemoved(f"{name} was removed on {when}, after its visit was {removal.reason}") from error
            raise StoreDamaged(f"{name} of {id} cannot be read: {error}") from error
        if hashlib.sha256(content).hexdigest() != files[name]:
            raise StoreDamaged(f"{name} of {id} is not what was kept: its SHA-256 differs")
        return content

    def refuse_light_in_vain(self) -> None:
        """Raise StoreFull or StoreReadOnly if a capture could not be stored: called before its light.

        A locked database is found by `DoseLedgerStore.reserve`, which writes the dose before the light, too.
        StoreLocked or StoreError if room must be made and the database or the disk refuses.
        """
        schema.refuse_if_read_only(self.engine)
        _refuse_read_only(self.folder, self._captures)
        self.space.refuse_without_room()
        if self.space.must_delete_files():
            with storage_errors(), atomic_io.file_lock(self._lock):
                self.space.make_room(0, self.space.press_files())

    def check_writable(self) -> None:
        """Write and remove a folder with a small file, as durably as a capture, and lock the database for writing.

        Errors: StoreFull, StoreReadOnly, StoreLocked, StoreError.
        """
        schema.refuse_if_read_only(self.engine)
        _refuse_read_only(self.folder, self._captures)
        trial = self.folder / ".trial"
        with storage_errors(), atomic_io.file_lock(self._lock):
            schema.lock_briefly(self.engine)
            shutil.rmtree(trial, ignore_errors=True)  # left by a killed process
            atomic_io.write_folder(trial, {"trial": b"written and removed"})
            shutil.rmtree(trial)

    @contextmanager
    def _reading(self) -> Iterator[Session]:
        with storage_errors(), Session(self.engine) as session:
            yield session

    def _set_damaged_database_aside(self) -> str | None:
        """Move a database that cannot be used to `damaged/`, so that it is rebuilt; return why, None for a usable one.

        A store without the folders of its visits cannot be rebuilt: its damaged database is opened as it is, row by
        row, and StoreDamaged is raised if it is missing or empty, because a new one has no rows for the captures.
        """
        database = self.folder / schema.DATABASE
        damage = damage_of(database)
        if damage is not None and RecordFiles(self.folder).exist():
            log.error("the database is moved to %s: %s", set_aside(database), damage)
            return damage
        missing = not database.exists() or database.stat().st_size == 0
        if missing and files_in(self._captures):
            raise StoreDamaged(f"{database} is gone, and there are captures that it should list")
        return None

    def _refuse_duplicate(self, *folders: Path) -> None:
        for folder in folders:
            if folder.exists():
                raise StoreError(f"{folder.name} is stored already", "Take the picture again.")


def _make_private(folder: Path) -> None:
    """Make the folder of the store, or take the rights of other users from it; unchanged where nothing can be written.

    StoreError if it belongs to another user, who alone may do that.
    """
    if folder.exists() and not os.access(folder, os.W_OK):
        return
    try:
        atomic_io.make_private(folder)
    except PermissionError as error:
        message = f"other users may read the folder {folder.name}, which belongs to one of them"
        remedy = "Give it to the user of this program (chown), or choose another with --data."
        raise StoreError(message, remedy) from error


def _refuse_read_only(*folders: Path) -> None:
    for folder in folders:
        if not os.access(folder, os.W_OK | os.X_OK):
            raise StoreReadOnly(f"the folder {folder.name} cannot be written")


def _row(session: Session, id: str) -> capture_rows.CaptureColumns:
    """Return the row of a capture, with the columns of CAPTURES; RecordNotFound if unknown or no valid id.

    StoreDamaged if the id in the row differs from the requested one.
    """
    known = capture_rows.NAME.fullmatch(id) is not None
    rows = capture_rows.capture_rows(session, capture_rows.CAPTURES.where(CaptureRow.id == id)) if known else []
    if not rows:
        raise RecordNotFound(f"there is no capture named {id!r}")
    row = rows[0]
    if row.id != id:  # the index still holds the id, the row does not
        raise StoreDamaged(f"the entry of {id!r} has another name", REMEDY)
    return row


def _sha256(content: FileContent) -> str:
    return hashlib.sha256(content).hexdigest() if isinstance(content, bytes) else content.sha256


def _length_bytes(content: FileContent) -> int:
    return len(content) if isinstance(content, bytes) else content.length_bytes


def _refuse_names(id: str, files: Mapping[str, FileContent]) -> None:
    for name in (id, *files):
        if not capture_rows.NAME.fullmatch(name):
            raise SettingError(f"{name!r} cannot name something kept", "Use letters, digits, dots and hyphens.")
    if CAPTURE_RECORD in files:
        raise SettingError(f"{CAPTURE_RECORD} is written by the store", "Give the file another name.")
    if not files:
        raise SettingError(f"{id} has no files, so there is nothing to keep")


@contextmanager
def _renamed_back_when_refused(kept: Path, part: Path) -> Iterator[None]:
    """Rename a folder back to its `.part` name if the block, which writes its rows, raises; a context manager.

    Nothing was committed then, so the next opening must quarantine the folder and not adopt it.
    """
    try:
        yield
    except BaseException:
        atomic_io.replace_durably(kept, part)
        raise


@contextmanager
def _removed_when_refused(*folders: Path) -> Iterator[None]:
    """Remove the given folders if the block fails on a full disk or a locked database; a context manager.

    After any other error the folders stay until the next opening, which looks for the row: a commit that failed in its
    last step may still have reached the disk.
    """
    try:
        yield
    except (OSError, DBAPIError) as error:
        if is_disk_full(error) or is_locked(error):
            for folder in folders:
                shutil.rmtree(folder, ignore_errors=True)  # a folder that stays has no row and is quarantined
        raise
