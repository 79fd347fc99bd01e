"""Pictures of visits: targets of captures, consent before light, decisions on slots, corrections of the eye."""

from collections.abc import Callable

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from device.clock import Clock
from device.errors import InputError, SettingError
from device.values import Eye
from services.errors import ConsentDeclined, ConsentMissing, RecordNotFound, VisitFinished
from services.records import laterality_correction, schema, visit_queries, visit_rows
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import ResumableCapture
from services.records.capture_target import CaptureTarget, Permit, RowWriter, permit_test_picture
from services.records.idempotent_requests import IdempotentRequests, key_conflict
from services.records.programme import CHOOSE_REMEDY, Programme
from services.records.schema import CaptureSlotRow
from services.records.storage_errors import storage_errors
from services.records.visit import SlotCapture, SlotDecision, Visit, decision_after

PRESS_REQUEST = "press"  # request text of every press; the record of the capture holds eye, visit and slot


class VisitPictures:
    """Pictures of the visits in the database of the capture store; thread-safe, writers are serialised.

    Each changing method takes an idempotency key first, as in VisitRepository, whose `get` reads a visit.
    """

    def __init__(
        self,
        engine: Engine,
        programme: Programme,
        clock: Clock,
        requests: IdempotentRequests,
        get: Callable[[str], Visit],
    ) -> None:
        self._engine, self._programme, self._clock, self._requests, self._get = engine, programme, clock, requests, get

    def capture_target(self, eye: Eye, key: str | None, id: str | None, slot: str | None) -> CaptureTarget:
        """Return the target of a capture of that eye; without a visit `id` or a slot, the target of a test picture.

        `key`: idempotency key, stored with the capture. Errors: InputError (the slot is of the other eye),
        RecordNotFound (unknown visit or slot), VisitFinished, ConsentMissing, ConsentDeclined.
        """
        request = None if key is None else self._requests.reference(key, PRESS_REQUEST)
        if id is None or slot is None:
            return CaptureTarget(
                write_rows=self._row_writer(key),
                request=request,
                frames=self._programme.frames,
                colours=self._programme.colours,
            )
        visit = self._get(id)
        programme_slot = self._programme.slot(slot)
        if programme_slot.eye != eye:
            raise InputError(f"{slot} is a picture of {programme_slot.eye}, not of {eye}", CHOOSE_REMEDY)
        if visit.finished_at is not None:
            raise VisitFinished("this visit is finished")
        permit = self.permission(id)
        permit()
        tries = len(visit.slots[slot].captures)
        colours = self._programme.colours if visit.no_colour is None else ()  # light that is not shown is not given
        return CaptureTarget(
            id,
            slot,
            tries,
            self._programme.retakes,
            programme_slot.field,
            self._row_writer(key),
            request,
            permit,
            self._programme.frames,
            colours,
        )

    def resumed_target(self, interrupted: ResumableCapture) -> CaptureTarget:
        """Return the target of a capture whose frames the run before has taken, also in a visit that is finished.

        RecordNotFound if the programme no longer has its slot.
        """
        key = interrupted.key
        entry = interrupted.press
        request = None if key is None else self._requests.reference(key, PRESS_REQUEST)
        field = None if entry.slot is None else self._programme.slot(entry.slot).field
        return CaptureTarget(
            entry.visit,
            entry.slot,
            entry.tries,
            self._programme.retakes,
            field,
            self._row_writer(key),
            request,
            self.permission(entry.visit),
            colours=interrupted.colours,
        )

    def permission(self, id: str | None) -> Permit:
        """Return a function that checks the consent of a visit, to be called before each light.

        Each call reads the recorded answer and raises ConsentDeclined for `declined`, ConsentMissing for anything but
        `agreed`, RecordNotFound for an unknown visit. Without a visit (None) the function never raises.
        """
        if id is None:
            return permit_test_picture

        def permit() -> None:
            with storage_errors(), Session(self._engine) as session:
                consent = visit_queries.consent(session, id)
            if consent == "declined":
                raise ConsentDeclined("this patient did not agree to pictures")
            if consent != "agreed":
                raise ConsentMissing("this patient has not agreed to pictures yet")

        return permit

    def capture_for_key(self, key: str, eye: Eye, visit: str | None, slot: str | None) -> str | None:
        """Return the id of the capture that a press with this idempotency key made; None for a new key.

        IdempotencyKeyConflict if the key belongs to a press for another eye, visit or slot, or to a request of another
        kind. The record of the capture holds eye, visit and slot.
        """
        with storage_errors(), Session(self._engine) as session:
            capture = self._requests.find(session, key, PRESS_REQUEST)
            if capture is None:
                return None
            if laterality_correction.requested_target(session, capture) != (eye, visit, slot):
                raise key_conflict()
            return capture

    def accept_capture(self, key: str, capture: str) -> Visit:
        """Choose a capture for the slot that it belongs to; return the visit.

        Errors: RecordNotFound (unknown capture or test picture), VisitFinished.
        """

        def act(session: Session) -> str:
            shot = laterality_correction.slot_row_of(session, capture)
            visit_rows.unfinished_row(session, shot.visit)
            visit_rows.decide(session, shot.visit, shot.slot, SlotDecision(capture))
            return shot.visit

        return self._run(key, f"keep {capture}", act)

    def correct_laterality(self, key: str, capture: str, eye: Eye, by: str | None, user: str = "") -> Visit:
        """Correct the eye of a capture: move the capture to the slot of that eye with the same field of view.

        If the capture already has that eye, record the confirmation. `by`: public name of the screen that requested the
        correction, or None; a move enters the history of the visit with `user`. Errors: RecordNotFound (unknown capture
        or test picture), VisitFinished, InputError (the programme has no such slot).
        """

        def act(session: Session) -> str:
            shot = laterality_correction.slot_row_of(session, capture)
            row = visit_rows.unfinished_row(session, shot.visit)
            before = visit_queries.read_visit(session, self._programme, row).slots
            to = laterality_correction.slot_of_same_field(self._programme, shot.slot, eye)
            from_slot = shot.slot
            if to.id == from_slot:
                laterality_correction.confirm(session, shot, self._clock.wall(), by)
                return shot.visit
            old_decision = before[from_slot].decision
            if old_decision is not None and old_decision.capture == capture:
                # The remaining captures of that eye determine its chosen one.
                visit_rows.decide(session, shot.visit, from_slot, None)
            verdict = next((taken.verdict for taken in before[from_slot].captures if taken.capture == capture), None)
            visit_rows.decide(session, shot.visit, to.id, decision_after(before[to.id], SlotCapture(capture, verdict)))
            now = schema.utc_text(self._clock.wall())
            visit_rows.record_change(session, shot.visit, "laterality", from_slot, to.id, now, user)
            laterality_correction.relabel(session, shot, to, self._clock.wall(), by)
            return shot.visit

        return self._run(key, f"move {capture} {eye}", act)

    def laterality_question(self) -> laterality_correction.LateralityQuestion | None:
        """Return the newest capture whose estimated eye differs from its recorded eye; None if there is none.

        Only the newest captures of unfinished visits are searched, without those already confirmed or corrected.
        """
        with storage_errors(), Session(self._engine) as session:
            return laterality_correction.newest_question(session)

    def choose(self, key: str, id: str, slot: str, capture: str | None) -> Visit:
        """Choose this capture for its slot, or empty the slot (None); replaces any earlier decision on the slot.

        Errors: RecordNotFound (unknown visit or slot, or a capture of another slot), VisitFinished.
        """

        def act(session: Session) -> str:
            visit_rows.unfinished_row(session, id)
            if capture is not None:
                shot = laterality_correction.slot_row_of(session, capture)
                if (shot.visit, shot.slot) != (id, slot):
                    raise RecordNotFound(f"this is not a picture of {slot} of this patient")
            visit_rows.decide(session, id, slot, SlotDecision(capture))
            return id

        self._programme.slot(slot)
        return self._run(key, f"choose {id} {slot} {capture}", act)

    def mark_not_possible(self, key: str, id: str, slot: str, reason: str) -> Visit:
        """Record that a picture of this slot was not possible, with a reason of the programme; earlier captures stay.

        Errors: InputError (unknown reason), RecordNotFound (unknown visit or slot), VisitFinished.
        """
        self._programme.slot(slot)
        if reason not in self._programme.reasons:
            raise InputError(
                f"reason: {reason[:40]!r} is none", f"Choose one of: {', '.join(self._programme.reasons)}."
            )

        def act(session: Session) -> str:
            visit_rows.unfinished_row(session, id)
            visit_rows.decide(session, id, slot, SlotDecision(reason=reason))
            return id

        return self._run(key, f"could not {id} {slot} {reason}", act)

    def _row_writer(self, key: str | None) -> RowWriter:
        """Return a function that writes rows in the transaction of a capture.

        Rows: the idempotency key of the press, if given, and the slot of the capture, if it has a visit.
        """

        def write(session: Session, capture: Capture) -> None:
            if key is not None:
                self._requests.store(session, key, PRESS_REQUEST, capture.id)
            if capture.report.visit is not None:
                self._add_to_slot(session, capture.id, capture.report)

        return write

    def _add_to_slot(self, session: Session, capture: str, report: CaptureReport) -> None:
        """Add a new capture to the slot in its report, also in a visit that was finished meanwhile.

        A finished visit gets a new outcome and a new `finished_at`, so that it is uploaded again.
        """
        id = report.visit
        slot = report.slot
        if id is None or slot is None:
            raise SettingError(f"the report of {capture} names no visit or no slot")
        row = visit_queries.visit_row(session, id)
        visit = visit_queries.read_visit(session, self._programme, row)
        session.add(CaptureSlotRow(capture=capture, visit=id, slot=slot))
        visit_rows.decide(session, id, slot, decision_after(visit.slots[slot], SlotCapture(capture, report.verdict)))
        if row.finished_at is not None:
            session.flush()
            visit_rows.finish(session, self._programme, row, schema.utc_text(self._clock.wall()))

    def _run(self, key: str, request: str, act: Callable[[Session], str]) -> Visit:
        """Run a change once, in a transaction; `act` returns the id of the visit, whose present state is returned."""
        return self._get(self._requests.run_in_transaction(key, request, act))
