"""Signing of records: changed patients, visits and captures get a new revision and digest in their rows, and a file.

A transaction changes rows; triggers make the digest of each changed record null. `recorded` signs
these records and replaces their files before it commits, so that each acknowledged state is in the database and in a
file. After a kill in between the file is one revision ahead, and recovery.py takes it over.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import Engine, Row, select, update
from sqlalchemy.orm import Session, selectinload

from device.errors import StoreError
from services.records import row_validation, schema
from services.records.record_document import Kind, RecordDocument
from services.records.record_files import RecordFiles
from services.records.record_rows import (
    Content,
    capture_content,
    file_entries,
    patient_contents,
    refuse_invalid,
    visit_contents,
)
from services.records.schema import CaptureRow, PatientRow, RecordRow, VisitRow
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

PAGE_ROWS = 500  # records per query where all are read


@contextmanager
def recorded(engine: Engine) -> Iterator[Session]:
    """Write transaction whose changed records are signed and written to their files before the commit.

    If the block or the commit fails, the files describe the rows as before. Errors: those of the block, of the disk and
    of SQLite, which `storage_errors` converts.
    """
    files = RecordFiles(schema.folder_of(engine), schema.key_of(engine))
    written = list[RecordDocument]()
    with Session(schema.for_writing(engine)) as session:
        try:
            with session.begin():
                yield session
                session.flush()
                written += sign_changed(session)
                files.write(written)
        except BaseException:
            _write_as_before(session, files, written)
            raise


def sign_changed(session: Session) -> list[RecordDocument]:
    """Give each record without a digest its next revision and its digest; return patients, captures, then visits.

    A visit is written last: its revision shows whether the captures of a correction were written. A record whose rows
    cannot be read stays unsigned.
    """
    return [document for kind in ("patient", "capture", "visit") for document in _sign_kind(session, kind)]


def documents_of(session: Session, kind: Kind, keys: Sequence[str]) -> list[RecordDocument]:
    """Return the records as their rows describe them, at the revision in the rows; without those that are unreadable.

    `keys`: ids of patients, visits or captures.
    """
    rows = rows_of(session, kind, keys)
    contents = contents_of(session, kind, rows)
    documents = []
    for row in rows:
        with suppress(ValueError, TypeError, KeyError):  # a damaged record
            documents.append(refuse_changed(kind, row, contents[schema.record_key(row)]))
    return documents


def pages_of_keys(session: Session, kind: Kind) -> Iterator[list[str]]:
    """Yield the readable primary keys of all records of a kind, PAGE_ROWS at a time; rows expire after each page."""
    keys = row_validation.readable_keys(session.scalars(select(schema.RECORD_KEYS[kind])))
    for start in range(0, len(keys), PAGE_ROWS):
        yield keys[start : start + PAGE_ROWS]
        session.expire_all()


def rows_of(session: Session, kind: Kind, keys: Sequence[str]) -> list[RecordRow]:
    """Return the rows of these records, captures with their file rows; unknown keys are omitted."""
    query = select(schema.RECORD_TABLES[kind]).where(schema.RECORD_KEYS[kind].in_(keys))
    if kind == "capture":
        query = query.options(selectinload(CaptureRow.files))
    return [row for row in session.scalars(query) if isinstance(row, PatientRow | VisitRow | CaptureRow)]


def contents_of(session: Session, kind: Kind, rows: Sequence[RecordRow]) -> dict[str, Content | ValueError]:
    """Return the content of each record by id, or the error of reading its rows."""
    if kind == "patient":
        return patient_contents([row for row in rows if isinstance(row, PatientRow)])
    if kind == "visit":
        return visit_contents(session, [row for row in rows if isinstance(row, VisitRow)])
    return {row.id: _capture_content(row) for row in rows if isinstance(row, CaptureRow)}


def _capture_content(row: CaptureRow) -> Content | ValueError:
    try:
        return capture_content(row, file_entries(row))
    except (ValueError, TypeError, RecursionError) as error:
        return ValueError(str(error))


def refuse_changed(kind: Kind, row: RecordRow | Row[*tuple[Any, ...]], content: Content | ValueError) -> RecordDocument:
    """Return the record in rows with that content.

    ValueError, TypeError or KeyError if it cannot be read, if its signed digest differs, or if it is unsigned and no
    content from which the rows could be restored.
    """
    if isinstance(content, ValueError):
        raise content
    document = RecordDocument(kind, row.revision, content)
    if row.record_sha256 is None:
        refuse_invalid(kind, content)
    elif document.sha256() != row.record_sha256:
        raise ValueError("the SHA-256 of the record differs")
    return document


def _sign_kind(session: Session, kind: Kind) -> list[RecordDocument]:
    table = schema.RECORD_TABLES[kind]
    key = schema.RECORD_KEYS[kind]
    keys = row_validation.readable_keys(session.scalars(select(key).where(table.record_sha256.is_(None))))
    signed = []
    for start in range(0, len(keys), PAGE_ROWS):
        page = keys[start : start + PAGE_ROWS]
        session.expire_all()
        for document in documents_of(session, kind, page):
            following = RecordDocument(kind, document.revision + 1, document.content)
            write_signature(session, following)
            signed.append(following)
    return signed


def write_signature(session: Session, document: RecordDocument) -> None:
    """Write revision and digest of a record into its row."""
    table = schema.RECORD_TABLES[document.kind]
    session.execute(
        update(table)
        .where(schema.RECORD_KEYS[document.kind] == document.id)
        .values(revision=document.revision, record_sha256=document.sha256())
        .execution_options(synchronize_session=False)
    )


def _write_as_before(session: Session, files: RecordFiles, written: Iterable[RecordDocument]) -> None:
    """Write the files of these records once more, as the rows describe them after the transaction was rolled back.

    If the disk refuses that too, a file stays one revision ahead, which the next opening takes over; it is logged.
    """
    try:
        with storage_errors():
            for document in written:
                before = documents_of(session, document.kind, [document.id])
                if before and before[0].revision > 0:
                    files.write(before)
                else:
                    files.remove(document.kind, document.id)
    except StoreError as error:
        log.error("files of records that were not committed stay: %s", error)
