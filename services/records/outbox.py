"""What waits to be sent: every finished visit that is not at the receiver as it was finished last.

It is asked of the visits, and not a list beside them: a finish puts a visit in, an undo takes it out, and a visit that
is finished again waits again. Written down is only what sending itself learns. Nothing is ever removed by it.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, Engine, and_, case, func, not_, or_, select, update
from sqlalchemy.orm import Session

from device.clock import Clock
from device.errors import DiffuscopeError, SendUnreachable
from services.records import reading, schema
from services.records.reading import one_record, readable
from services.records.schema import FileRow, SendingRow, ShotRow, VisitRow
from services.records.store import told

PATIENCE = timedelta(days=3)  # in which nobody has to do anything about a link that fails
OWN = ("picture.png", "report.json")  # of each capture, what is sent
# In the very words of the index `visits_to_send`.
UNSENT = and_(VisitRow.finished_at.is_not(None), or_(VisitRow.sent.is_(None), VisitRow.sent != VisitRow.finished_at))
OF_ITS_FINISH = and_(SendingRow.visit == VisitRow.id, SendingRow.finished_at == VisitRow.finished_at)


@dataclass(frozen=True)
class Waiting:
    """A visit that waits: since its finish; how often it was tried, since when in vain, and why (`error`, a code).

    `stuck`: somebody has to do something, for what keeps it does not pass, or has not passed for days.
    """

    visit: str
    number: str
    finished_at: datetime
    tries: int = 0
    failing_since: datetime | None = None
    error: str | None = None
    said: str | None = None
    stuck: bool = False
    size_bytes: int = 0


@dataclass(frozen=True)
class Trouble:
    """How many wait; how many of them are stuck, since when; and how many were tried in vain, and are not stuck."""

    waiting: int
    stuck: int
    stuck_since: datetime | None
    failing: int


@dataclass(frozen=True)
class Receipt:
    """What the receiver was seen to have: the SHA-256 of the parcel, `confirmed` by "sha256" or by its "length"."""

    sha256: str
    confirmed: str


class Outbox:
    """The question what waits, and what became of it; any thread may ask."""

    def __init__(self, engine: Engine, clock: Clock) -> None:
        self.engine, self.clock = engine, clock

    def waiting(
        self, limit: int | None = None, *, parked: Collection[str] | None = None, sizes: bool = False
    ) -> list[Waiting]:
        """Those that wait, the one that was finished first before the others.

        With `parked`, without those that such errors keep; with `sizes`, how large each is. One whose rows cannot be
        read is left out: it is damaged, and the list of visits counts it.
        """
        query = select(VisitRow, SendingRow, self._stuck()).outerjoin(SendingRow, OF_ITS_FINISH).where(UNSENT)
        if parked is not None:
            query = query.where(or_(SendingRow.error.is_(None), SendingRow.error.not_in(parked)))
        query = query.order_by(VisitRow.finished_at, VisitRow.id)
        with told(), Session(self.engine) as session:
            rows = session.execute(query.limit(limit)).all()
            found = readable(rows, lambda row: _waiting(*row))
            if len(found) < len(rows):  # what cannot be read must not stand before the others for ever
                found = readable(session.execute(query).all(), lambda row: _waiting(*row))[:limit]
            return _with_sizes(session, found) if sizes else found

    def trouble(self) -> Trouble:
        """How many wait, and how it stands with them."""
        stuck, failing = self._stuck(), SendingRow.error.is_not(None)
        numbers = func.count(), func.count(case((stuck, 1))), func.count(case((and_(failing, not_(stuck)), 1)))
        query = select(*numbers).select_from(VisitRow).outerjoin(SendingRow, OF_ITS_FINISH).where(UNSENT)
        dates = select(SendingRow.failing_since).join(VisitRow, OF_ITS_FINISH).where(UNSENT, stuck)
        with told(), Session(self.engine) as session:
            waiting, many, tried = session.execute(query).one()
            since = readable(session.scalars(dates).all(), _since) if many else []
        return Trouble(waiting, many, min((one for one in since if one is not None), default=None), tried)

    def _stuck(self) -> ColumnElement[bool]:
        """Kept by what does not pass, or by a link that has failed for days."""
        long_ago = schema.utc_text(self.clock.wall() - PATIENCE)
        passes = and_(SendingRow.error == SendUnreachable.code, SendingRow.failing_since > long_ago)
        return and_(SendingRow.error.is_not(None), not_(passes))

    def sent(self, day: str) -> int:
        """How many visits of a day are at the receiver."""
        query = select(func.count()).select_from(VisitRow)
        with told(), Session(self.engine) as session:
            return session.scalar(query.where(VisitRow.day == day, VisitRow.sent == VisitRow.finished_at)) or 0

    def failed(self, which: Sequence[Waiting], error: DiffuscopeError) -> None:
        """A try came to nothing, of all these: where the receiver cannot be reached, everybody waits for it."""
        now = schema.utc_text(self.clock.wall())
        with told(), Session(schema.for_writing(self.engine)) as session, session.begin():
            for one in which:
                row = _row(session, one)
                row.tries, row.error, row.said = row.tries + 1, error.code, error.message
                row.failing_since = row.failing_since or now

    def arrived(self, one: Waiting, receipt: Receipt) -> None:
        """The receiver has it. A visit that was opened or finished again meanwhile is not sent by that."""
        now, finish = self.clock.wall(), schema.utc_text(one.finished_at)
        with told(), Session(schema.for_writing(self.engine)) as session, session.begin():
            row = _row(session, one)
            row.tries, row.error, row.said, row.failing_since = row.tries + 1, None, None, None
            row.sent_at, row.sha256, row.confirmed = schema.utc_text(now), receipt.sha256, receipt.confirmed
            session.execute(update(VisitRow).where(VisitRow.id == one.visit).values(sent=finish))

    def forget(self, visit: str | None) -> None:
        """What kept one of those that wait (None: all) is said to be mended."""
        query = select(SendingRow).join(VisitRow, OF_ITS_FINISH).where(UNSENT)
        if visit is not None:
            query = query.where(SendingRow.visit == visit)
        with told(), Session(schema.for_writing(self.engine)) as session, session.begin():
            for row in session.scalars(query):
                row.error = row.said = None


def _waiting(visit: VisitRow, sending: SendingRow | None, stuck: bool | None) -> Waiting:
    """StoreDamaged if a row cannot be read; also if the finish is not written as this program writes it, for then it
    would never be found to be sent."""
    with one_record(visit.id):
        id, number = reading.text(visit.id), reading.text(visit.person)
        finished_at = reading.moment(visit.finished_at)
        reading.one_of(visit.finished_at, schema.utc_text(finished_at))
        if sending is None:
            return Waiting(id, number, finished_at)
        error, said = (None if one is None else reading.text(one) for one in (sending.error, sending.said))
        since = _since(sending.failing_since)
        return Waiting(id, number, finished_at, sending.tries, since, error, said, stuck=bool(stuck))


def _since(value: object) -> datetime | None:
    with one_record("since when it could not be sent"):
        return None if value is None else reading.moment(value)


def _row(session: Session, one: Waiting) -> SendingRow:
    """What is written down of this finish of a visit; a new row if there is nothing yet."""
    finish = schema.utc_text(one.finished_at)
    row = session.get(SendingRow, (one.visit, finish))
    if row is None:
        row = SendingRow(visit=one.visit, finished_at=finish, tries=0)
        session.add(row)
    return row


def _with_sizes(session: Session, found: Sequence[Waiting]) -> list[Waiting]:
    query = (
        select(ShotRow.visit, func.sum(FileRow.bytes))
        .join(FileRow, FileRow.capture_id == ShotRow.capture)
        .where(ShotRow.visit.in_([one.visit for one in found]), FileRow.name.in_(OWN))
        .group_by(ShotRow.visit)
    )
    sizes = {visit: int(size) for visit, size in session.execute(query)}
    return [replace(one, size_bytes=sizes.get(one.visit, 0)) for one in found]
