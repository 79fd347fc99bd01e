"""Adoption: rows rebuilt from the records of whole capture folders, for rows that are lost or cannot be read.

Rows are lost with a damaged write-ahead log, with a copy of the store without it, or with an older database. A folder
with a valid record (capture_record.py) and all files in it gets its rows back at the next opening.
"""

import logging
from pathlib import Path

from sqlalchemy import Engine, delete
from sqlalchemy.orm import Session

from device.errors import StoreError
from services.records import capture_record, capture_rows, schema
from services.records.capture_report import parse_report
from services.records.schema import CaptureRow, CaptureSlotRow, FileRow, VisitRow
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

PAGE_ROWS = 500  # rows per query where all rows are read


class Adoption:
    """Rebuilding of the rows of captures from the folders in `captures`; the caller holds the lock of the store."""

    def __init__(self, captures: Path, engine: Engine) -> None:
        self._captures, self._engine = captures, engine

    def rebuild_missing(self, folders: list[Path]) -> tuple[str, ...]:
        """Insert the rows of those of the folders that have a record, by name; return the ids of those adopted.

        A folder whose record or files are damaged is left as it is and logged. A `.part` folder was never renamed, so
        its capture was not acknowledged.
        """
        described = [one for one in folders if not one.name.startswith(".") and (one / capture_record.RECORD).is_file()]
        return tuple(folder.name for folder in sorted(described) if self._rebuild(folder))

    def heal_damaged(self) -> tuple[str, ...]:
        """Replace each row that cannot be read by that of its folder's record; return the ids of those healed.

        A database of which no row can be read is left as it is and logged: the store still opens.
        """
        try:
            return tuple(id for id in self._damaged_ids() if self._rebuild(self._captures / id))
        except StoreError as error:
            log.error("damaged rows of captures were not searched: %s", error)
            return ()

    def _rebuild(self, folder: Path) -> bool:
        """Write the rows of one folder in one transaction; return False if that fails, which is logged only.

        It fails if the record or a file is damaged, or if the database takes no rows, for example on a full disk. The
        folder stays as it is, the store opens, and the next opening tries again.
        """
        try:
            row = capture_record.read_row(folder)
            with storage_errors(), Session(schema.for_writing(self._engine)) as session, session.begin():
                _replace(session, row)
        except StoreError as error:
            log.warning("capture folder %s stays without a readable row: %s", folder.name, error)
            return False
        log.warning("rows of capture %s rebuilt from its record", folder.name)
        return True

    def _damaged_ids(self) -> list[str]:
        """Return the ids of the rows that cannot be read and whose id still names a folder."""
        with storage_errors(), Session(self._engine) as session:
            damaged = [row.id for page in capture_rows.pages(session, PAGE_ROWS) for row in page.damaged]
        named = [id for id in damaged if isinstance(id, str) and capture_rows.NAME.fullmatch(id)]
        return [id for id in named if (self._captures / id).is_dir()]


def _replace(session: Session, row: CaptureRow) -> None:
    """Insert or update the row of a capture, its file rows, and its slot if the visit is in the database."""
    report = parse_report(row.report)
    session.execute(delete(FileRow).where(FileRow.capture_id == row.id))
    session.merge(row)
    session.flush()
    if report.visit is not None and report.slot is not None and session.get(VisitRow, report.visit) is not None:
        session.merge(CaptureSlotRow(capture=row.id, visit=report.visit, slot=report.slot))
