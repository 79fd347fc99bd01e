"""The book of light on the shelf: what an eye got outlives the process, the power and the date (device/ledger.py)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from sqlalchemy import Engine, Integer, delete, literal_column, select
from sqlalchemy.orm import Session

from device.clock import Clock
from device.errors import LightLimit, StoreError
from device.ledger import SLOT_S, Page, Reserved
from device.values import EYES, Eye
from services.records import schema
from services.records.dose_copy import DoseCopy
from services.records.schema import LightRow, SeenRow
from services.records.store import told

_AS_IT_IS = {"synchronize_session": False}
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
REMEDY = "The light stays off while what it gives cannot be written down. Free some space, or call the technician."


def this_boot() -> str:
    """The name of the time since the computer started; where there is none, this call's own: then less time counts."""
    return BOOT_ID.read_text(encoding="ascii").strip() if BOOT_ID.is_file() else uuid4().hex


def count_also(session: Session, eye: Eye, dose_j_per_cm2: float) -> None:
    """Count light for an eye that got it under another's name; it is given already, so nothing is asked or refused.

    It ages from the last light of the book, which is that light itself or a later one.
    """
    seen = session.get(SeenRow, 1)
    slot = int(seen.observed_s // SLOT_S) if seen is not None else 0
    row = session.get(LightRow, (eye, slot))
    before = row.dose_j_per_cm2 if row is not None else 0.0
    session.merge(LightRow(eye=eye, slot=slot, dose_j_per_cm2=before + dose_j_per_cm2))


class LightBook:
    """A Ledger in the shelf's database; each change is on the disk when its call returns, whoever else writes.

    Opening it marks the moment from which this boot's time counts, and raises what is lower than in the copy beside
    the database (`dose_copy.py`).
    """

    def __init__(self, engine: Engine, clock: Clock, window_s: float, boot: str | None = None) -> None:
        self._engine, self._clock, self._window_s = engine, clock, window_s
        self._boot = boot or this_boot()
        self._copy = DoseCopy(Path(str(engine.url.database)).with_name("light.copy"))
        with self._writing() as page:
            self._copy.higher(page)
            page.look(self._boot, self._clock.now_s(), self._window_s)

    def spent_j_per_cm2(self, eye: Eye) -> float:
        """What an eye has got in the window, reservations that were never settled included."""
        with told(), Session(self._engine) as session:
            return self._page(session).spent(eye)

    def reserve(self, eyes: Sequence[Eye], dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        """Count a dose before it is given; the time that was seen is written down even when it is refused."""
        refused: LightLimit | None = None
        with self._writing() as page:
            try:
                reserved = page.reserve(eyes, dose_j_per_cm2, stop_j_per_cm2, self._window_s, self._clock.wall())
            except LightLimit as error:
                refused = error
        if refused is not None:
            raise refused
        return reserved

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        """Count what was really given instead."""
        with self._writing() as page:
            page.settle(reserved, given_j_per_cm2)

    @contextmanager
    def _writing(self) -> Iterator[Page]:
        """The book, alone; what is changed in it is on the disk at the end."""
        try:
            with told(), Session(schema.for_writing(self._engine)) as session, session.begin():
                page = self._page(session)
                yield page
                number = literal_column("light_doses.rowid", Integer)
                rows = session.execute(select(number, LightRow.eye, LightRow.slot)).all()
                gone = [row for row, eye, slot in rows if (eye, slot) not in page.doses]
                if gone:
                    session.execute(delete(LightRow).where(number.in_(gone)), execution_options=_AS_IT_IS)
                for (eye, slot), dose_j_per_cm2 in page.doses.items():
                    session.merge(LightRow(eye=eye, slot=slot, dose_j_per_cm2=dose_j_per_cm2))
                session.merge(SeenRow(id=1, boot=page.boot, now_s=page.now_s, observed_s=page.observed_s))
            with told():
                self._copy.write(page)
        except StoreError as error:
            raise type(error)(f"the book of light cannot be written: {error.message}", REMEDY) from error

    def _page(self, session: Session) -> Page:
        page = Page()
        for row in session.scalars(select(LightRow)):
            eyes = (row.eye,) if row.eye in EYES else EYES  # which eye it was cannot be read: then both
            page.add(eyes, row.slot, row.dose_j_per_cm2)
        seen = session.get(SeenRow, 1)
        if seen is not None:
            page.observed_s, page.boot, page.now_s = seen.observed_s, seen.boot, seen.now_s
        page.look(self._boot, self._clock.now_s(), self._window_s)
        return page
