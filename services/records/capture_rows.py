"""Rows of the capture table and their conversion to `Capture`; an unreadable row affects its own capture only."""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, Select, select
from sqlalchemy.orm import Session

from device.values import EYES
from services.errors import StoreDamaged
from services.records import row_validation
from services.records.capture import Capture, CaptureReport
from services.records.record_rows import FileEntry, capture_content
from services.records.record_signing import refuse_changed
from services.records.schema import CAPTURE_ROWID, CaptureRow, FileRow

CAPTURES: Select[*tuple[Any, ...]] = select(
    CAPTURE_ROWID,
    CaptureRow.id,
    CaptureRow.eye,
    CaptureRow.taken_at,
    CaptureRow.simulated,
    CaptureRow.calibration_id,
    CaptureRow.report,
    CaptureRow.request,
    CaptureRow.revision,
    CaptureRow.record_sha256,
)
CaptureColumns = Row[*tuple[Any, ...]]
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")  # capture id, and name of a file


def capture_rows(session: Session, query: Select[*tuple[Any, ...]]) -> Sequence[CaptureColumns]:
    """Return the rows of a query derived from CAPTURES (with a filter, an order or a limit), without validation."""
    return session.execute(query).all()


@dataclass(frozen=True)
class Page:
    """One page of captures, newest first, and its rows that cannot be read."""

    captures: list[Capture]
    damaged: list[CaptureColumns]


def pages(session: Session, size: int, before: int | None = None) -> Iterator[Page]:
    """Yield all captures, last stored first, in pages of `size` rows; only row numbers below `before`, if given."""
    while True:
        query = CAPTURES.order_by(CAPTURE_ROWID.desc()).limit(size)
        rows = capture_rows(session, query if before is None else query.where(before > CAPTURE_ROWID))
        if not rows:
            return
        files = files_of(session, rows)
        page = Page([], [])
        for row in rows:
            try:
                page.captures.append(capture_of(row, files))
            except StoreDamaged:
                page.damaged.append(row)
        yield page
        before = rows[-1].kept


def capture_of(row: CaptureColumns, files: Mapping[str, Sequence[FileEntry]]) -> Capture:
    """Return the capture of a row of CAPTURES; `files` maps each capture id to (name, SHA-256, length) of its files.

    StoreDamaged if the row or a file's row cannot be read or differs from the digest, or if the capture has no files.
    """
    with row_validation.reading_record(row.id):
        if not NAME.fullmatch(row_validation.text(row.id)) or row.id not in files:
            raise ValueError("no files belong to it")
        refuse_changed("capture", row, capture_content(row, files[row.id]))
        return Capture(
            id=row.id,
            eye=row_validation.one_of(row.eye, *EYES),
            taken_at=row_validation.timestamp(row.taken_at),
            simulated=bool(row_validation.one_of(row.simulated, 0, 1)),
            calibration_id=row_validation.text(row.calibration_id),
            report=CaptureReport.parse(row.report),
            files={row_validation.text(name): row_validation.text(digest) for name, digest, _ in files[row.id]},
        )


def files_of(session: Session, rows: Sequence[CaptureColumns]) -> dict[str, list[FileEntry]]:
    """Return (name, SHA-256, length) of the files of these captures by capture id, sorted by name, without validation.

    Captures with an invalid id or without files are absent.
    """
    ids = [row.id for row in rows if isinstance(row.id, str) and NAME.fullmatch(row.id)]
    found: dict[str, list[FileEntry]] = defaultdict(list)
    query = select(FileRow.capture_id, FileRow.name, FileRow.sha256, FileRow.bytes).where(FileRow.capture_id.in_(ids))
    for capture, name, digest, length in session.execute(query.order_by(FileRow.name)):
        found[capture].append((name, digest, length))
    return found
