"""Dose ledger in the database: the dose of each eye persists across restarts, power cuts and clock changes."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from sqlalchemy import Engine, Integer, delete, literal_column, select
from sqlalchemy.orm import Session

from device.clock import Clock, boot_id
from device.errors import LightLimit, StoreError
from device.light_safety.dose_ledger import INTERVAL_S, DoseLedgerState, Reserved
from device.values import EYES, Eye
from services.records import schema
from services.records.dose_ledger_log import DoseLedgerLog, raise_doses
from services.records.reserve_file import ReserveFile
from services.records.schema import CaptureRow, DoseRow, ObservedTimeRow
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

LOST_J_PER_CM2 = 100.0  # counted for each eye if the ledger is gone: above the limit of every day
_AS_IT_IS = {"synchronize_session": False}
REMEDY = "The light stays off while what it gives cannot be written down. Call the technician."


def add_given_dose(session: Session, eye: Eye, dose_j_per_cm2: float) -> None:
    """Add a dose (J/cm2) to `eye` for a capture that was recorded for the other eye; the limit is not checked.

    The dose is added, in both copies, to the interval of the later of their observed times, at or after the exposure.
    """
    engine, seen = session.get_bind().engine, session.get(ObservedTimeRow, 1)
    ledger_log = DoseLedgerLog(schema.folder_of(engine), schema.key_of(engine))
    copy = ledger_log.newest()
    interval = int(max((each.observed_s for each in (seen, copy) if each is not None), default=0.0) // INTERVAL_S)
    row = session.get(DoseRow, (eye, interval))
    before = row.dose_j_per_cm2 if row is not None else 0.0
    session.merge(DoseRow(eye=eye, interval=interval, dose_j_per_cm2=before + dose_j_per_cm2))
    if copy is not None:
        copy.add((eye,), interval, dose_j_per_cm2)
        ledger_log.append(copy)


class DoseLedgerStore:
    """Dose ledger in the database of the capture store; each change is durable when its call returns.

    A dose counts for at least `window_s` (s) of observed time. Each reading takes the higher dose of the tables and the
    second copy (dose_ledger_log.py) for each interval, and the lower observed time, under which more of it counts;
    opening adds the time since the last observation if it was in the same boot. If both are gone while the store has
    captures, both eyes count as full. Writers are serialised, across processes too. StoreError if the ledger cannot be
    read or written.
    """

    def __init__(self, engine: Engine, clock: Clock, window_s: float, boot: str | None = None) -> None:
        self._engine, self._clock, self._window_s = engine, clock, window_s
        # With a random id the time between two openings does not count as observed, so doses expire later.
        self._boot = boot or boot_id()
        self._log = DoseLedgerLog(schema.folder_of(engine), schema.key_of(engine))
        self._reserve = ReserveFile(schema.folder_of(engine))
        is_lost = self._is_lost()
        with self._writing() as state:
            if is_lost:
                log.error("the dose ledger of a used device is gone: both eyes count as full")
                state.add(EYES, int(state.observed_s // INTERVAL_S), LOST_J_PER_CM2)

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """Return the dose (J/cm2) of an eye that still counts, including reservations that were never settled."""
        with storage_errors(), Session(self._engine) as session:
            return self._state(session).spent(eye)

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose (J/cm2) for each of the eyes before the exposure; return the reservation for `settle`.

        LightLimit if the dose of an eye would exceed `stop_j_per_cm2`: then no dose is counted. The observed time is
        stored in both cases. StoreFull or StoreReadOnly if the store takes no changes: no light without its record.
        """
        schema.refuse_if_read_only(self._engine)
        refused: LightLimit | None = None
        with self._writing() as state:
            try:
                reserved = state.reserve(eyes, dose_j_per_cm2, stop_j_per_cm2, self._window_s, self._clock.wall())
            except LightLimit as error:
                refused = error
        if refused is not None:
            raise refused
        return reserved

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Replace the dose of a reservation by the dose (J/cm2) that was given, for each of its eyes."""

        def write() -> None:
            with self._writing() as state:
                state.settle(reserved, given_j_per_cm2)

        self._reserve.retried(write)

    @contextmanager
    def _writing(self) -> Iterator[DoseLedgerState]:
        """Yield the current state of the ledger in an exclusive transaction; a context manager.

        Write the state to the second copy and to the database at the end; after an exception in the block neither. If
        only the commit fails, the copy has the change, and the higher dose counts.
        """
        try:
            with storage_errors(), Session(schema.for_writing(self._engine)) as session, session.begin():
                state = self._state(session)
                yield state
                number = literal_column("doses.rowid", Integer)
                rows = session.execute(select(number, DoseRow.eye, DoseRow.interval)).all()
                gone = [row for row, eye, interval in rows if (eye, interval) not in state.doses]
                if gone:
                    session.execute(delete(DoseRow).where(number.in_(gone)), execution_options=_AS_IT_IS)
                for (eye, interval), dose_j_per_cm2 in state.doses.items():
                    session.merge(DoseRow(eye=eye, interval=interval, dose_j_per_cm2=dose_j_per_cm2))
                session.merge(ObservedTimeRow(id=1, boot=state.boot, now_s=state.now_s, observed_s=state.observed_s))
                session.flush()
                self._log.append(state)
        except StoreError as error:
            remedy = REMEDY if type(error) is StoreError else error.remedy
            raise type(error)(f"the dose ledger cannot be written: {error.message}", remedy) from error

    def _is_lost(self) -> bool:
        """Return whether the store has captures, but neither table nor copy of the ledger has ever been written."""
        with storage_errors(), Session(self._engine) as session:
            if session.get(ObservedTimeRow, 1) is not None or self._log.newest() is not None:
                return False
            return session.scalar(select(CaptureRow.id).limit(1)) is not None

    def _state(self, session: Session) -> DoseLedgerState:
        state = DoseLedgerState()
        for row in session.scalars(select(DoseRow)):
            eyes = (row.eye,) if row.eye in EYES else EYES  # unreadable eye: count for both
            state.add(eyes, row.interval, row.dose_j_per_cm2)
        copies, now_s = list[DoseLedgerState](), self._clock.now_s()
        if (seen := session.get(ObservedTimeRow, 1)) is not None:
            copies.append(DoseLedgerState({}, seen.observed_s, seen.boot, seen.now_s))
        if (copy := self._log.newest()) is not None:
            raise_doses(state, copy)
            copies.append(copy)
        state.observed_s = min((each.observed_at_s(self._boot, now_s) for each in copies), default=0.0)
        state.advance(self._boot, now_s, self._window_s)
        return state
