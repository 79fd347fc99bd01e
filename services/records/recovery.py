"""Recovery at each opening: rows that are lost, damaged or older than the files of their records are restored.

Rows are lost with a damaged write-ahead log, a copy of the store without it, or an older database. Each record of a
patient, a visit or a capture is in its rows and in a file (record_document.py), both with a revision and a digest:

    rows                    file                    action
    whole, signed           same revision           none
    whole, newer            older or damaged        write the file
    whole, older            newer                   restore the rows from the file
    whole, unsigned         no newer revision       sign the rows, write the file (another program changed them)
    whole, unsigned         newer, other content    the later change is used, the other is stored in `conflicts/`
    another patient's       whole                   restore with another number: patients are never mixed up
    damaged or missing      whole                   restore the rows from the file
    damaged                 damaged or missing      none: one damaged record in the lists

A file that another program wrote counts as damaged: its HMAC is not that of the store's key. A store that is opened
with a key for the first time, such as a copy without its key, takes its files as they are and writes all of them again.

A database that is missing or fails SQLite's integrity check is moved to `damaged/` and rebuilt from the files.
"""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime
from pathlib import Path

from sqlalchemy import Engine, delete, select
from sqlalchemy.orm import Session

from device import atomic_io
from device.errors import StoreError
from services.errors import StoreDamaged
from services.records import record_rows, row_validation, schema
from services.records.dose_ledger_log import DoseLedgerLog
from services.records.earlier_stores import refuse_earlier_store
from services.records.json_values import JsonObject
from services.records.patient_rows import index_of
from services.records.record_document import Kind, RecordDocument
from services.records.record_files import RecordFiles, new_key, note_key
from services.records.record_rows import Content
from services.records.record_signing import (
    contents_of,
    documents_of,
    pages_of_keys,
    refuse_changed,
    rows_of,
    sign_changed,
    write_signature,
)
from services.records.recovery_report import RecoveryReport
from services.records.removed_captures import MARK, is_large
from services.records.schema import CaptureRow, RecordRow, VisitRow
from services.records.snapshots import move_to_numbered_folder, refuse_in_use
from services.records.storage_errors import sqlite_name, storage_errors

log = logging.getLogger(__name__)


def damage_of(database: Path) -> str | None:
    """Return why a database cannot be used: missing, empty, or what SQLite's integrity check found; None if it can."""
    if not database.exists() or database.stat().st_size == 0:
        return "it is missing or empty"
    try:
        with closing(sqlite3.connect(database)) as connection:
            connection.text_factory = schema.decoded
            found = connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
            tables = connection.execute(schema.SCHEMA_TEXT).fetchall()
            checksum = connection.execute("PRAGMA user_version").fetchone()[0]
    except UnicodeDecodeError:  # of SQLite's message about a damaged definition
        return "the definitions of its tables are no UTF-8"
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError) and sqlite_name(error) != "SQLITE_ERROR":
            raise  # busy, or refused by the disk: nothing is known about the content
        return str(error)
    if found == "ok" and checksum != (schema.schema_checksum(tables) if tables else 0):
        return "the definitions of its tables are not those that were written"
    return None if found == "ok" else str(found)


def set_aside(database: Path) -> Path:
    """Move a database with its logs to the next free folder `damaged/<n>`; return that folder. OSError on failure."""
    return move_to_numbered_folder(database, database.parent / "damaged", "")


class Recovery:
    """Recovery of the rows of the store in `folder`; the caller holds the lock of the store."""

    def __init__(self, folder: Path, engine: Engine, rebuilt_because: str | None) -> None:
        self._folder = folder
        self._engine = engine
        key = schema.key_of(engine)
        self._new_key = new_key(folder, key)
        # The dose ledger is written after the first opening with a key: then its note was removed, and no file is new.
        is_first = self._new_key is not None and DoseLedgerLog(folder, key).newest() is None
        self._files = RecordFiles(folder, None if is_first else key)
        self.report = RecoveryReport(rebuilt_because=rebuilt_because)
        self._restored_visits: list[tuple[RecordDocument, bool]] = []

    def run(self) -> RecoveryReport:
        """Restore what has to be restored, sign what is unsigned, and write the files that are missing or older.

        A failure, for example on a full disk, is logged only: nothing is changed then, the store opens, and the next
        opening tries again.
        """
        try:
            with storage_errors(), Session(schema.for_writing(self._engine)) as session, session.begin():
                self._files.make_folders()
                self._run(session)
        except StoreError as error:
            log.error("rows were not compared with the files of their records: %s", error)
            return RecoveryReport(rebuilt_because=self.report.rebuilt_because)
        self._log()
        return self.report

    def _run(self, session: Session) -> None:
        to_write = [*self._reconcile(session, "patient"), *self._reconcile(session, "visit")]
        suspicious = {*self.report.visits, *(record.id for record in to_write if record.kind == "visit")}
        to_write += self._reconcile(session, "capture", suspicious)
        if self.report.adopted:
            named = select(CaptureRow.visit).where(CaptureRow.visit.not_in(select(VisitRow.id))).distinct()
            self.report.lost_visits += [visit for visit in session.scalars(named) if visit is not None]
        record_rows.restore_slots(session)
        for document, as_described in self._restored_visits:
            missing = record_rows.restore_decisions(session, document.content)
            self.report.missing += missing
            if as_described and not missing:
                write_signature(session, document)
        self._files.write_all([*to_write, *sign_changed(session)])
        index_of(session).numbers(session)  # decrypts all of them now, not in the first search
        if self._new_key is not None:
            RecordFiles(self._folder, self._new_key).write_all(_documents(session))
            note_key(self._folder, self._new_key)

    def _reconcile(self, session: Session, kind: Kind, of_visits: set[str] | None = None) -> list[RecordDocument]:
        """Compare the rows of all records of a kind with their files and restore rows; return the files to write.

        The file of a capture is read only if its rows are damaged or unsigned, or belong to one of `of_visits`.
        """
        to_write = []
        known = set[str]()
        for page in pages_of_keys(session, kind):
            rows = rows_of(session, kind, page)
            contents = contents_of(session, kind, rows)
            for row in rows:
                rows_document = _document_in_rows(kind, row, contents[schema.record_key(row)])
                id = schema.record_key(row)
                known.add(id)
                if _is_settled(kind, row, rows_document, of_visits):
                    continue
                to_write += self._compare(session, row, rows_document, self._file(kind, id))
        for id in self._files.ids(kind):
            if id not in known and (document := self._file(kind, id)) is not None:
                self._restore(session, document, known=False)
        return to_write

    def _compare(
        self, session: Session, row: RecordRow, in_rows: RecordDocument | None, in_file: RecordDocument | None
    ) -> list[RecordDocument]:
        """Restore the rows of one record from its file, or return the document of the rows, if the file needs it."""
        if in_rows is None:
            if in_file is not None:
                self._restore(session, in_file)
            return []
        signed = row.record_sha256 is not None
        if in_file is None or in_file.revision < in_rows.revision:
            return [in_rows] if signed else []
        if in_file.sha256() == RecordDocument(in_rows.kind, in_file.revision, in_rows.content).sha256():
            if not signed or in_file.revision > in_rows.revision:
                write_signature(session, in_file)
            return []
        if signed and in_file.revision > in_rows.revision:
            self._restore(session, in_file)
        elif signed or in_file.revision > in_rows.revision:
            self._settle_conflict(session, in_rows, in_file)
        return []

    def _settle_conflict(self, session: Session, in_rows: RecordDocument, in_file: RecordDocument) -> None:
        """Use the state that was changed later, the file's if both are equally late; store the other beside it.

        Conflicts arise after older tables were restored: what had been changed was changed once more.
        """
        use_file = _last_change(in_file.content) >= _last_change(in_rows.content)
        folder = self._folder / "conflicts"
        other = in_rows if use_file else in_file
        atomic_io.make_folder(folder)
        name = f"{other.kind}-{other.id}-{other.revision}-{other.sha256()[:8]}.json"
        atomic_io.write_atomically(folder / name, other.encoded())
        self.report.conflicts.append(other.id)
        if use_file:
            self._restore(session, in_file)
        else:  # above the revision of the file, so that the rows are the newer state
            write_signature(session, RecordDocument(in_rows.kind, in_file.revision + 1, in_rows.content))
            self._files.write([RecordDocument(in_rows.kind, in_file.revision + 1, in_rows.content)])

    def _restore(self, session: Session, document: RecordDocument, known: bool = True) -> None:
        """Write the rows of a record from its document; a document that does not fit is logged and left as it is."""
        try:
            with row_validation.reading_record(document.id), storage_errors(), session.begin_nested():
                if not known:
                    _delete_misnamed(session, document)
                as_described = True
                if document.kind == "patient":
                    as_described = record_rows.restore_patient(session, document.content)
                    self.report.patients.append(document.id)
                elif document.kind == "visit":
                    as_described = record_rows.restore_visit(session, document.content)
                    self.report.visits.append(document.id)
                    self._restored_visits.append((document, as_described))
                else:
                    self._restore_capture(session, document)
                    (self.report.healed if known else self.report.adopted).append(document.id)
                if not as_described:
                    self.report.conflicts.append(document.id)
                else:
                    write_signature(session, document)
        except StoreError as error:
            log.error("rows of the %s %s were not restored: %s", document.kind, document.id, error)

    def _restore_capture(self, session: Session, document: RecordDocument) -> None:
        row = record_rows.capture_row(document.content)
        folder = self._folder / "captures" / row.id
        is_removed = (folder / MARK).exists()
        for file in row.files:
            if is_removed and is_large(file.name):
                continue
            path = folder / file.name
            if Path(file.name).name != file.name or not path.is_file() or path.stat().st_size != file.bytes:
                raise StoreDamaged(f"{file.name!a} of {row.id} is missing or has another length")
        record_rows.restore_capture(session, row)

    def _file(self, kind: Kind, id: str) -> RecordDocument | None:
        """Return the document in the file of a record; None without one, or if it is damaged, which is logged."""
        try:
            return self._files.read(kind, id) if id else None
        except StoreDamaged as error:
            log.error("%s", error)
            return None

    def _log(self) -> None:
        report = self.report
        if report.rebuilt_because is not None:
            log.error("the database was rebuilt from the files of the store: %s", report.rebuilt_because)
        for what, ids in (
            ("captures without rows were adopted", report.adopted),
            ("captures with damaged or older rows were healed", report.healed),
            ("visits were restored from their files", report.visits),
            ("patients were restored from their files", report.patients),
            ("records had two states, one of which is now in conflicts/", report.conflicts),
            ("chosen captures have no folder any more", report.missing),
            ("visits of adopted captures are gone", report.lost_visits),
        ):
            if ids:
                log.warning("%d %s: %s", len(ids), what, ", ".join(ids[:20]))


def _documents(session: Session) -> Iterator[RecordDocument]:
    """Yield the records of all readable rows."""
    kinds: tuple[Kind, ...] = ("patient", "visit", "capture")
    for kind in kinds:
        for page in pages_of_keys(session, kind):
            yield from documents_of(session, kind, page)


def _delete_misnamed(session: Session, document: RecordDocument) -> None:
    """Delete the row that has the digest of this record under another key: its key is damaged."""
    table = schema.RECORD_TABLES[document.kind]
    session.execute(
        delete(table)
        .where(table.record_sha256 == document.sha256(), schema.RECORD_KEYS[document.kind] != document.id)
        .execution_options(synchronize_session=False)
    )


def _document_in_rows(kind: Kind, row: RecordRow, content: Content | ValueError) -> RecordDocument | None:
    """Return the record in rows; None if they cannot be read or differ from their digest."""
    try:
        return refuse_changed(kind, row, content)
    except (ValueError, TypeError, KeyError):
        return None


def _is_settled(kind: Kind, row: RecordRow, in_rows: RecordDocument | None, of_visits: set[str] | None) -> bool:
    """Return whether the file of a capture need not be read: its rows are signed and whole, its visit is settled."""
    if kind != "capture" or in_rows is None or row.record_sha256 is None or not isinstance(row, CaptureRow):
        return False
    return row.visit not in (of_visits or set())


def _last_change(content: JsonObject) -> datetime:
    """Return the latest timestamp anywhere in a record, in UTC."""
    return max(_timestamps(content))


def _timestamps(value: object) -> list[datetime]:
    if isinstance(value, dict):
        return [timestamp for entry in value.values() for timestamp in _timestamps(entry)]
    if isinstance(value, list):
        return [timestamp for entry in value for timestamp in _timestamps(entry)]
    try:
        return [row_validation.timestamp(value)]
    except ValueError:
        return []


def rebuild_database(folder: Path) -> Path:
    """Move the database of a store that is not in use aside; the next opening rebuilds it. Return where it is now.

    Errors: StoreDamaged (the folders of the files are missing), StoreError (the instrument is running, or the store is
    of a version before the first release), OSError.
    """
    refuse_earlier_store(folder / schema.DATABASE)
    if not RecordFiles(folder).exist():
        raise StoreDamaged(f"{folder} has no files of its visits", "Copy them back beside the database first.")
    refuse_in_use(folder / schema.DATABASE)
    with atomic_io.file_lock(folder / ".lock"):
        return set_aside(folder / schema.DATABASE)
