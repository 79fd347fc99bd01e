"""Persons and their visits on the shelf: an answer is on the disk before it is acknowledged, a repeat is harmless."""

import hashlib
import json
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Engine, delete
from sqlalchemy.orm import Session

from device.clock import Clock
from device.errors import ConsentDeclined, ConsentMissing, InputError, NotKept, VisitFinished
from device.values import Capture, Eye
from services.records import answers, moving, numbering, schema, visits
from services.records.errand import Beside, Errand, Permit, permit_test_picture
from services.records.protocol import CHOOSE, Protocol
from services.records.schema import CounterRow, FieldRow, IdentifierRow, KeyRow, PersonRow, ShotRow, SlotRow, VisitRow
from services.records.store import told
from services.records.visit import Decided, Taken, Visit, decided_after, outcome

PRESS = "press"  # of every press: its eye, visit and slot are in the record of the capture
REMEMBERED = timedelta(days=30)  # no network repeats a request for longer


class People:
    """Persons and visits in the shelf's database; any thread may ask, and those who write wait for each other."""

    def __init__(self, engine: Engine, protocol: Protocol, clock: Clock) -> None:
        self.engine, self.protocol, self.clock = engine, protocol, clock

    def begin(self, key: str, number: str | None = None) -> Visit:
        """A new visit: of the person of that number, or of somebody new; without a number the next automatic one.

        Errors: InputError for what is no number, or for an automatic one with a wrong check digit.
        """

        number = None if number is None else numbering.tidy(number)

        def act(session: Session) -> str:
            now = self.clock.wall()
            session.execute(delete(KeyRow).where(KeyRow.done_at < schema.utc_text(now - REMEMBERED)))
            person = self._person(session, number)
            id = f"{now:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}"
            day = now.astimezone().date().isoformat()
            session.add(VisitRow(id=id, person=person, day=day, begun_at=schema.utc_text(now)))
            return id

        return self.get(self._once(key, f"begin {number}", act))

    def get(self, id: str) -> Visit:
        """One visit; NotKept if there is none, StoreDamaged if it cannot be read."""
        with told(), Session(self.engine) as session:
            return visits.read_one(session, self.protocol, visits.row(session, id))

    def visits(
        self, limit: int, day: str | None = None, open: bool | None = None, digits: str | None = None
    ) -> list[Visit]:
        """The newest visits, newest first: of a day, unfinished or finished ones, with these digits in the number.

        Without those that `damaged` counts.
        """
        digits = numbering.whole(digits.upper()) if digits else None
        with told(), Session(self.engine) as session:
            return visits.read(session, self.protocol, visits.found(session, limit, day, open, digits))

    def damaged(self) -> int:
        """How many visits cannot be read: they are not listed, and asked for alone are refused."""
        with told(), Session(self.engine) as session:
            return visits.damaged(session, self.protocol)

    def counts(self, day: str | None = None) -> dict[str, int]:
        """How many visits of a day (None: of all) are done, are to be finished, and were referred."""
        with told(), Session(self.engine) as session:
            return visits.counts(session, day)

    def answer(self, key: str, id: str, name: str, value: Any) -> Visit:
        """Write one answer down; None is none. InputError if it cannot be one, VisitFinished if too late.

        Clearing an identifying field deletes it; no history is kept.
        """
        value = answers.checked(name, value)

        def act(session: Session) -> str:
            person, now = self._open(session, id).person, schema.utc_text(self.clock.wall())
            if name not in answers.IDENTIFIERS:  # "nothing" is an answer too: no drops were given
                session.merge(FieldRow(visit=id, name=name, value=json.dumps(value), set_at=now))
            elif value is not None:
                session.merge(IdentifierRow(person=person, name=name, value=json.dumps(value)))
            elif (known := session.get(IdentifierRow, (person, name))) is not None:
                session.delete(known)
            return id

        return self.get(self._once(key, f"answer {id} {name} {json.dumps(value)}", act))

    def errand(self, eye: Eye, key: str | None, id: str | None, slot: str | None) -> Errand:
        """What is to be done with a picture of that eye; without a visit it is a test picture.

        Errors: InputError (the slot is of the other eye), VisitFinished, ConsentMissing, ConsentDeclined.
        """
        if id is None or slot is None:
            return Errand(beside=self._beside(key))
        visit, wanted = self.get(id), self.protocol.slot(slot)
        if wanted.eye != eye:
            raise InputError(f"{slot} is a picture of {wanted.eye}, not of {eye}", CHOOSE)
        if visit.finished_at is not None:
            raise VisitFinished(f"{visit.number} is finished")
        permit = self.permission(id)
        permit()
        tries = len(visit.slots[slot].taken)
        return Errand(id, slot, tries, self.protocol.retakes, wanted.field, self._beside(key), permit)

    def permission(self, id: str | None) -> Permit:
        """A check of the consent of a visit, to be called before each light; without a visit it allows test pictures.

        It reads the recorded answer at each call. Errors: ConsentMissing or ConsentDeclined unless it is `agreed` now,
        NotKept if there is no such visit.
        """
        if id is None:
            return permit_test_picture

        def permit() -> None:
            with told(), Session(self.engine) as session:
                number, consent = visits.consent(session, id)
            if consent == "declined":
                raise ConsentDeclined(f"{number} did not agree to pictures")
            if consent != "agreed":
                raise ConsentMissing(f"{number} has not agreed to pictures yet")

        return permit

    def _beside(self, key: str | None) -> Beside:
        """What is kept with a capture: the key of the press that made it, and its place."""

        def write(session: Session, capture: Capture) -> None:
            if key is not None:
                self._remember(session, key, PRESS, capture.id)
            if capture.report["visit"] is not None:
                self._put(session, capture)

        return write

    def answered(self, key: str, eye: Eye, visit: str | None, slot: str | None) -> str | None:
        """What a press with this key was answered: the name of its capture; None if there was none.

        InputError if the key was that of another request: of another eye, visit or slot, or no press. The record of
        the capture says of which, so a key that an earlier release wrote down is bound too.
        """
        with told(), Session(self.engine) as session:
            row = session.get(KeyRow, key)
            if row is None:
                return None
            capture = _same(row, PRESS)
            if moving.asked_for(session, capture) != (eye, visit, slot):
                raise other_request()
            return capture

    def keep(self, key: str, capture: str) -> Visit:
        """Make a capture the one that stands for its slot; NotKept if it belongs to no visit."""

        def act(session: Session) -> str:
            shot = moving.place_of(session, capture)
            self._open(session, shot.visit)
            _decide(session, shot.visit, shot.slot, Decided(capture))
            return shot.visit

        return self.get(self._once(key, f"keep {capture}", act))

    def move(self, key: str, capture: str, eye: Eye, by: str | None) -> Visit:
        """A picture is of that eye: if it was taken as the other one's, it goes to that eye's slot of the same part.

        `by` is who says so. Where that eye was named at the press already, that is written down.
        Errors: NotKept (it belongs to no visit), VisitFinished, InputError (the programme has no such slot).
        """

        def act(session: Session) -> str:
            shot = moving.place_of(session, capture)
            before = self._read(session, self._open(session, shot.visit)).slots
            to, left = moving.same_field(self.protocol, shot.slot, eye), shot.slot
            if to.id == left:
                moving.confirm(session, shot, self.clock.wall(), by)
                return shot.visit
            stood = before[left].decided
            if stood is not None and stood.capture == capture:  # what is left of that eye speaks for itself
                _decide(session, shot.visit, left, None)
            verdict = next(one.verdict for one in before[left].taken if one.capture == capture)
            _decide(session, shot.visit, to.id, decided_after(before[to.id], Taken(capture, verdict)))
            moving.relabel(session, shot, to, self.clock.wall(), by)
            return shot.visit

        return self.get(self._once(key, f"move {capture} {eye}", act))

    def asked_side(self) -> moving.Question | None:
        """The newest picture that seems to be of the other eye, while nobody said which eye it is of."""
        with told(), Session(self.engine) as session:
            return moving.question(session)

    def choose(self, key: str, id: str, slot: str, capture: str | None) -> Visit:
        """Make a capture of that very slot stand for it, or empty the slot (None); either ends a "could not"."""

        def act(session: Session) -> str:
            self._open(session, id)
            if capture is not None:
                shot = moving.place_of(session, capture)
                if (shot.visit, shot.slot) != (id, slot):
                    raise NotKept(f"this is not a picture of {slot} of this person")
            _decide(session, id, slot, Decided(capture))
            return id

        self.protocol.slot(slot)
        return self.get(self._once(key, f"choose {id} {slot} {capture}", act))

    def could_not(self, key: str, id: str, slot: str, reason: str) -> Visit:
        """Write down that a picture could not be taken, and why; the pictures that were tried stay."""
        self.protocol.slot(slot)
        if reason not in self.protocol.reasons:
            raise InputError(f"reason: {reason[:40]!r} is none", f"Choose one of: {', '.join(self.protocol.reasons)}.")

        def act(session: Session) -> str:
            self._open(session, id)
            _decide(session, id, slot, Decided(reason=reason))
            return id

        return self.get(self._once(key, f"could not {id} {slot} {reason}", act))

    def finish(self, key: str, id: str) -> Visit:
        """Finish a visit with what there is; its outcome is told by the programme's rules. Finished ones stay."""

        def act(session: Session) -> str:
            row = visits.row(session, id)
            if row.finished_at is None:
                self._tell_outcome(session, row)
                row.finished_at = schema.utc_text(self.clock.wall())
            return id

        return self.get(self._once(key, f"finish {id}", act))

    def reopen(self, key: str, id: str) -> Visit:
        """Undo a finish, on the day on which it was finished; then VisitFinished."""

        def act(session: Session) -> str:
            row = visits.row(session, id)
            if row.finished_at is not None and self.undo_until(datetime.fromisoformat(row.finished_at)) is None:
                raise VisitFinished(f"{row.person} was finished on an earlier day")
            row.finished_at = row.outcome = None
            return id

        return self.get(self._once(key, f"reopen {id}", act))

    def once(self, key: str, request: str, act: Callable[[], str]) -> str:
        """Do something that is none of ours, and remember its answer; a repetition is only answered.

        It is not done inside a transaction: it may take long, and others want to write.
        """
        with told(), Session(self.engine) as session:
            before = session.get(KeyRow, key)
        if before is not None:
            return _same(before, request)
        answer = act()
        return self._once(key, request, lambda _: answer)

    def undo_until(self, finished_at: datetime) -> datetime | None:
        """When what was finished then can no longer be undone: at the end of that day; None if that is over."""
        day = finished_at.astimezone().replace(hour=0, minute=0, second=0, microsecond=0)
        end = day + timedelta(days=1)
        return end if self.clock.wall() < end else None

    def _read(self, session: Session, row: VisitRow) -> Visit:
        return visits.read_one(session, self.protocol, row)

    def _tell_outcome(self, session: Session, row: VisitRow) -> None:
        """Write down how a visit ends by what is known of it now."""
        visit = self._read(session, row)
        told = outcome(self.protocol, visit.fields, visit.slots)
        row.outcome = json.dumps({"code": told.code, "sentence": told.sentence})

    def _once(self, key: str, request: str, act: Callable[[Session], str]) -> str:
        """Do it, and remember the answer in the same transaction; a repetition is only answered."""
        with self._writing() as session:
            before = session.get(KeyRow, key)
            if before is None:
                answer = act(session)
                self._remember(session, key, request, answer)
                return answer
            return _same(before, request)

    def _person(self, session: Session, number: str | None) -> str:
        """The person of a number, or a new one; of digits alone, who has them after the programme's prefix."""
        prefix = self.protocol.programme.prefix
        if number is None:
            number = self._next_number(session, prefix)
        elif session.get(PersonRow, number) is None and session.get(PersonRow, prefix + number) is not None:
            number = prefix + number
        elif numbering.looks_automatic(prefix, number) and not numbering.is_checked(prefix, number):
            raise InputError(f"number: {number} is mistyped: its last digit does not fit", "Type the number again.")
        if session.get(PersonRow, number) is None:
            session.add(PersonRow(number=number, made_at=schema.utc_text(self.clock.wall())))
            session.flush()
        return number

    def _next_number(self, session: Session, prefix: str) -> str:
        """The next automatic number that nobody has."""
        counter = session.get(CounterRow, prefix) or CounterRow(prefix=prefix, last=0)
        session.add(counter)
        while True:
            counter.last += 1
            if session.get(PersonRow, number := numbering.numbered(prefix, counter.last)) is None:
                return number

    def _open(self, session: Session, id: str) -> VisitRow:
        """A visit in which something may still be changed."""
        row = visits.row(session, id)
        if row.finished_at is not None:
            raise VisitFinished(f"{row.person} is finished")
        return row

    def _put(self, session: Session, capture: Capture) -> None:
        """Put a new capture into its slot; also of a visit that was finished meanwhile: no picture is lost.

        Such a visit ends anew, now and by what is known of it: so it is sent again too.
        """
        id, slot = capture.report["visit"], capture.report["slot"]
        row = visits.row(session, id)
        visit = self._read(session, row)
        session.add(ShotRow(capture=capture.id, visit=id, slot=slot))
        _decide(session, id, slot, decided_after(visit.slots[slot], Taken(capture.id, capture.report.get("verdict"))))
        if row.finished_at is not None:
            session.flush()
            self._tell_outcome(session, row)
            row.finished_at = schema.utc_text(self.clock.wall())

    @contextmanager
    def _writing(self) -> Iterator[Session]:
        with told(), Session(schema.for_writing(self.engine)) as session, session.begin():
            yield session

    def _remember(self, session: Session, key: str, request: str, answer: str) -> None:
        now = schema.utc_text(self.clock.wall())
        session.add(KeyRow(key=key, request=_digest(request), answer=answer, done_at=now))


def _decide(session: Session, visit: str, slot: str, decided: Decided | None) -> None:
    """Write a decision about a slot down, or take it back."""
    if decided is not None:
        session.merge(SlotRow(visit=visit, slot=slot, capture=decided.capture, reason=decided.reason))
    elif (row := session.get(SlotRow, (visit, slot))) is not None:
        session.delete(row)


def _same(before: KeyRow, request: str) -> str:
    """What this very request was answered; InputError if the key was another's."""
    if before.request != _digest(request):
        raise other_request()
    return before.answer


def other_request() -> InputError:
    """What is said to a key that was used for something else."""
    return InputError("key: it belongs to another request", "Reload the page and try again.")


def _digest(request: str) -> str:
    """What a key remembers of its request: enough to know it again, nothing that could be read."""
    return hashlib.sha256(request.encode("utf-8", "backslashreplace")).hexdigest()
