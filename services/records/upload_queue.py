"""Upload queue: the finished visits whose last finished state the receiver has not confirmed.

The queue is a query on the visits: a finish adds a visit, an undo of the finish removes it, and a second finish adds it
again. The table `uploads` stores only the results of the upload attempts. The queue deletes no rows.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, Engine, and_, case, func, not_, or_, select, update
from sqlalchemy.orm import Session

from device.clock import Clock
from device.errors import DiffuscopeError
from services.errors import ReceiverUnreachable
from services.records import patient_rows, row_validation, schema
from services.records.capture import COLOUR
from services.records.record_signing import recorded
from services.records.row_validation import reading_record, without_damaged
from services.records.schema import CaptureSlotRow, FileRow, UploadRow, VisitRow
from services.records.storage_errors import storage_errors

STUCK_AFTER = timedelta(days=3)  # an unreachable receiver needs no attention before
UPLOADED_FILES = ("picture.png", COLOUR, "report.json")  # uploaded files of each capture
# Same expression as the partial index `visits_to_upload`, so that SQLite uses it.
UNSENT = and_(VisitRow.finished_at.is_not(None), or_(VisitRow.sent.is_(None), VisitRow.sent != VisitRow.finished_at))
SAME_FINISH = and_(UploadRow.visit == VisitRow.id, UploadRow.finished_at == VisitRow.finished_at)


@dataclass(frozen=True)
class QueuedVisit:
    """A visit in the queue, with the upload attempts since its last finish.

    `visit`: visit id; `number`: patient number; `tries`: number of attempts; `failing_since`: first failure; `error`,
    `message`: code and text of the last error (None: no error, or cleared). `stuck`: the visit needs help from a user,
    because the error is not ReceiverUnreachable, or because the receiver has been unreachable for longer than
    STUCK_AFTER. `size_bytes`: size on the disk of its pictures and reports, 0 unless requested.
    """

    visit: str
    number: str
    finished_at: datetime
    tries: int = 0
    failing_since: datetime | None = None
    error: str | None = None
    message: str | None = None
    stuck: bool = False
    size_bytes: int = 0


@dataclass(frozen=True)
class QueueStatus:
    """Numbers of visits in the queue: all (`waiting`), stuck, and with an error but not stuck (`failing`).

    `stuck_since`: earliest start of the failures of a stuck visit; None if no visit is stuck.
    """

    waiting: int
    stuck: int
    stuck_since: datetime | None
    failing: int


@dataclass(frozen=True)
class UploadReceipt:
    """Proof of an upload: SHA-256 of the archive (hexadecimal), and how the receiver confirmed the upload.

    `confirmed`: "sha256" if the receiver returned the same SHA-256, "length" if it returned only the same length.
    """

    sha256: str
    confirmed: str


class UploadQueue:
    """Upload queue in the database of the capture store; thread-safe."""

    def __init__(self, engine: Engine, clock: Clock) -> None:
        self.engine, self.clock = engine, clock

    def queued(
        self, limit: int | None = None, *, without_errors: Collection[str] | None = None, sizes: bool = False
    ) -> list[QueuedVisit]:
        """Return the visits in the queue, the earliest finish first, at most `limit`.

        `limit` None: all. `without_errors`: omit visits whose last error has one of these codes. `sizes`: fill in
        `size_bytes`. Visits whose rows cannot be read are omitted.
        """
        query = select(VisitRow, UploadRow, self._stuck()).outerjoin(UploadRow, SAME_FINISH).where(UNSENT)
        if without_errors is not None:
            query = query.where(or_(UploadRow.error.is_(None), UploadRow.error.not_in(without_errors)))
        query = query.order_by(VisitRow.finished_at, VisitRow.id)
        with storage_errors(), Session(self.engine) as session:
            rows = session.execute(query.limit(limit)).all()
            found = without_damaged(rows, lambda row: _waiting(session, *row))
            if len(found) < len(rows):  # damaged rows must not use up the limit
                found = without_damaged(session.execute(query).all(), lambda row: _waiting(session, *row))[:limit]
            return _with_sizes(session, found) if sizes else found

    def status(self) -> QueueStatus:
        """Return the numbers of waiting, stuck and failing visits; visits with unreadable rows are counted too."""
        stuck = self._stuck()
        failing = UploadRow.error.is_not(None)
        numbers = func.count(), func.count(case((stuck, 1))), func.count(case((and_(failing, not_(stuck)), 1)))
        query = select(*numbers).select_from(VisitRow).outerjoin(UploadRow, SAME_FINISH).where(UNSENT)
        dates = select(UploadRow.failing_since).join(VisitRow, SAME_FINISH).where(UNSENT, stuck)
        with storage_errors(), Session(self.engine) as session:
            waiting, many, tried = session.execute(query).one()
            since = without_damaged(session.scalars(dates).all(), _failing_since) if many else []
        return QueueStatus(waiting, many, min((moment for moment in since if moment is not None), default=None), tried)

    def _stuck(self) -> ColumnElement[bool]:
        """Return the SQL condition of a stuck visit.

        True if its last error is not ReceiverUnreachable, or if its attempts have failed for longer than STUCK_AFTER.
        """
        long_ago = schema.utc_text(self.clock.wall() - STUCK_AFTER)
        passes = and_(UploadRow.error == ReceiverUnreachable.code, UploadRow.failing_since > long_ago)
        return and_(UploadRow.error.is_not(None), not_(passes))

    def uploaded_count(self, day: str) -> int:
        """Return the number of visits of a local day (ISO 8601 date of the visit) whose last finish was uploaded."""
        query = select(func.count()).select_from(VisitRow)
        with storage_errors(), Session(self.engine) as session:
            return session.scalar(query.where(VisitRow.day == day, VisitRow.sent == VisitRow.finished_at)) or 0

    def sent_visits(self) -> set[str]:
        """Return the ids of the visits whose last finished state the receiver has confirmed."""
        with storage_errors(), Session(self.engine) as session:
            return set(session.scalars(select(VisitRow.id).where(VisitRow.sent == VisitRow.finished_at)))

    def record_failure(self, which: Sequence[QueuedVisit], error: DiffuscopeError) -> None:
        """Record one failed attempt with this error for each of these visits.

        The worker records an error of the receiver for every visit in the queue, not only for the attempted one.
        """
        now = schema.utc_text(self.clock.wall())
        with storage_errors(), Session(schema.for_writing(self.engine)) as session, session.begin():
            for entry in which:
                row = _attempt_row(session, entry)
                row.tries = row.tries + 1
                row.error = error.code
                row.message = error.message
                row.failing_since = row.failing_since or now

    def record_success(self, entry: QueuedVisit, receipt: UploadReceipt) -> None:
        """Record a confirmed upload of a visit as finished at `entry.finished_at`, and clear its error.

        A visit that was finished again meanwhile stays in the queue.
        """
        now = self.clock.wall()
        finish = schema.utc_text(entry.finished_at)
        with storage_errors(), recorded(self.engine) as session:
            row = _attempt_row(session, entry)
            row.tries = row.tries + 1
            row.error = None
            row.message = None
            row.failing_since = None
            row.sent_at = schema.utc_text(now)
            row.sha256 = receipt.sha256
            row.confirmed = receipt.confirmed
            session.execute(update(VisitRow).where(VisitRow.id == entry.visit).values(sent=finish))

    def clear_errors(self, visit: str | None) -> None:
        """Clear code and text of the last error of one visit in the queue (None: of all), so that it is tried again."""
        query = select(UploadRow).join(VisitRow, SAME_FINISH).where(UNSENT)
        if visit is not None:
            query = query.where(UploadRow.visit == visit)
        with storage_errors(), Session(schema.for_writing(self.engine)) as session, session.begin():
            for row in session.scalars(query):
                row.error = row.message = None


def _waiting(session: Session, visit: VisitRow, upload: UploadRow | None, stuck: bool | None) -> QueuedVisit:
    """Return a queue entry from its rows (`upload` None: no attempt yet); StoreDamaged if a row cannot be read.

    StoreDamaged too if `finished_at` is not in the notation of `schema.utc_text`: it would never equal `sent`.
    """
    with reading_record(visit.id):
        id = row_validation.text(visit.id)
        number, _ = patient_rows.identity(session, row_validation.text(visit.patient))
        finished_at = row_validation.timestamp(visit.finished_at)
        row_validation.one_of(visit.finished_at, schema.utc_text(finished_at))
        if upload is None:
            return QueuedVisit(id, number, finished_at)
        error, message = (
            None if value is None else row_validation.text(value) for value in (upload.error, upload.message)
        )
        since = _failing_since(upload.failing_since)
        return QueuedVisit(id, number, finished_at, upload.tries, since, error, message, stuck=bool(stuck))


def _failing_since(value: object) -> datetime | None:
    with reading_record("since when it could not be sent"):
        return None if value is None else row_validation.timestamp(value)


def _attempt_row(session: Session, entry: QueuedVisit) -> UploadRow:
    """Return the row of `uploads` of (visit, finish time); add one with 0 tries to the transaction if missing."""
    finish = schema.utc_text(entry.finished_at)
    row = session.get(UploadRow, (entry.visit, finish))
    if row is None:
        row = UploadRow(visit=entry.visit, finished_at=finish, tries=0)
        session.add(row)
    return row


def _with_sizes(session: Session, found: Sequence[QueuedVisit]) -> list[QueuedVisit]:
    query = (
        select(CaptureSlotRow.visit, func.sum(FileRow.bytes))
        .join(FileRow, FileRow.capture_id == CaptureSlotRow.capture)
        .where(CaptureSlotRow.visit.in_([entry.visit for entry in found]), FileRow.name.in_(UPLOADED_FILES))
        .group_by(CaptureSlotRow.visit)
    )
    sizes = {visit: int(size) for visit, size in session.execute(query)}
    return [replace(entry, size_bytes=sizes.get(entry.visit, 0)) for entry in found]
