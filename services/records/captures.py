"""Captures as the tables have them, and as values: a capture whose rows cannot be read is damaged, and no other is."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Row, Select, select
from sqlalchemy.orm import Session

from device.values import EYES, Capture
from services.records import reading
from services.records.schema import KEPT, CaptureRow, FileRow

CAPTURES: Select[*tuple[Any, ...]] = select(
    KEPT, CaptureRow.id, CaptureRow.eye, CaptureRow.taken_at, CaptureRow.simulated, CaptureRow.calibration_id,
    CaptureRow.report,
)  # fmt: skip
CaptureColumns = Row[*tuple[Any, ...]]
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")  # of a capture, and of each of its files


def capture_rows(session: Session, query: Select[*tuple[Any, ...]]) -> Sequence[CaptureColumns]:
    """The rows of a query that narrows CAPTURES, as they are: nothing in them is known to be readable."""
    return session.execute(query).all()


def capture_of(row: CaptureColumns, files: Mapping[str, Sequence[tuple[object, object]]]) -> Capture:
    """The capture of a row of CAPTURES, with the names and SHA-256 of `files`, by capture; its moment is in UTC.

    StoreDamaged if one of its rows cannot be read.
    """
    with reading.one_record(row.id):
        if not NAME.fullmatch(reading.text(row.id)) or row.id not in files:
            raise ValueError("no files belong to it")
        return Capture(
            id=row.id,
            eye=reading.one_of(row.eye, *EYES),
            taken_at=reading.moment(row.taken_at),
            simulated=bool(reading.one_of(row.simulated, 0, 1)),
            calibration_id=reading.text(row.calibration_id),
            report=reading.report(row.report),
            files={reading.text(name): reading.text(digest) for name, digest in files[row.id]},
        )


def files_of(session: Session, rows: Sequence[CaptureColumns]) -> dict[str, list[tuple[object, object]]]:
    """The names and SHA-256 of the files of these captures, by capture."""
    ids = [row.id for row in rows if isinstance(row.id, str) and NAME.fullmatch(row.id)]
    found: dict[str, list[tuple[object, object]]] = defaultdict(list)
    query = select(FileRow.capture_id, FileRow.name, FileRow.sha256).where(FileRow.capture_id.in_(ids))
    for capture, name, digest in session.execute(query.order_by(FileRow.name)):
        found[capture].append((name, digest))
    return found
