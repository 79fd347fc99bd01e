"""Correction of the eye of a capture: move the capture to the slot of the other eye, or confirm the recorded eye."""

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import Row, select
from sqlalchemy.orm import Session

from device.errors import InputError
from device.values import EYES, Eye
from services.errors import RecordNotFound
from services.records import row_validation, schema
from services.records.capture import CaptureReport, EyeConfirmation, EyeCorrection
from services.records.dose_ledger_tables import add_given_dose
from services.records.programme import CHOOSE_REMEDY, Programme, Slot
from services.records.schema import CaptureRow, CaptureSlotRow, VisitRow, json_extract_or_null

SEARCHED_CAPTURES = 8  # number of newest captures that are searched: more than a visit has
OTHER_EYE: dict[str, Eye] = {"OD": "OS", "OS": "OD"}


@dataclass(frozen=True)
class LateralityQuestion:
    """A capture (`id`, `slot`) whose eye estimated from the picture (`other`) differs from its recorded eye."""

    id: str
    slot: str
    other: Eye


def newest_question(session: Session) -> LateralityQuestion | None:
    """Return the newest capture of an unfinished visit whose estimated eye differs from its recorded eye.

    Only the last SEARCHED_CAPTURES captures are searched, without those whose eye was confirmed or corrected. None if
    there is none.
    """
    newest = select(CaptureRow.id).order_by(schema.CAPTURE_ROWID.desc()).limit(SEARCHED_CAPTURES)
    seen = json_extract_or_null(CaptureRow.laterality, "$.eye")
    moved, confirmed = (json_extract_or_null(CaptureRow.report, f"$.{name}") for name in ("moved", "confirmed"))
    found = session.execute(
        select(CaptureRow.id, CaptureRow.eye, CaptureSlotRow.slot)
        .join(CaptureSlotRow, CaptureSlotRow.capture == CaptureRow.id)
        .join(VisitRow, VisitRow.id == CaptureSlotRow.visit)
        .where(CaptureRow.id.in_(newest), VisitRow.finished_at.is_(None))
        .where(seen.in_(OTHER_EYE), CaptureRow.eye.in_(OTHER_EYE), seen != CaptureRow.eye)
        .where(moved.is_(None), confirmed.is_(None))
        .order_by(schema.CAPTURE_ROWID.desc())
    ).all()
    return next(iter(row_validation.without_damaged(found, _question)), None)


def _question(row: Row[str, str, str]) -> LateralityQuestion:
    with row_validation.reading_record(row.id):
        return LateralityQuestion(row_validation.text(row.id), row_validation.text(row.slot), OTHER_EYE[row.eye])


def slot_row_of(session: Session, capture: str) -> CaptureSlotRow:
    """Return the row with visit and slot of a capture; RecordNotFound if it is unknown or a test picture."""
    shot = session.get(CaptureSlotRow, capture)
    if shot is not None:
        return shot
    if session.get(CaptureRow, capture) is None:
        raise RecordNotFound(f"there is no capture named {capture!r}")
    raise RecordNotFound("this is a test picture: it belongs to no patient", "Take the picture again for this patient.")


def requested_target(session: Session, capture: str) -> tuple[str, str | None, str | None]:
    """Return the eye, visit and slot that were requested for a capture, before any correction of its eye.

    Visit and slot are None for a test picture. RecordNotFound if unknown, StoreDamaged if its report is unreadable.
    """
    row = session.get(CaptureRow, capture)
    if row is None:
        raise RecordNotFound("the picture of this press is not saved here", "Take the picture again.")
    report = _report(row)
    if report.moved:
        return report.moved[0].from_eye, report.visit, report.moved[0].from_slot
    return row.eye, report.visit, report.slot


def slot_of_same_field(programme: Programme, slot: str, eye: Eye) -> Slot:
    """Return the first slot of that eye with the same field of view as `slot`.

    InputError if the programme has none, RecordNotFound if `slot` is unknown.
    """
    field = programme.slot(slot).field
    for candidate in programme.slots:
        if (candidate.eye, candidate.field) == (eye, field):
            return candidate
    raise InputError(f"eye: the programme has no picture of the {field} of {eye}", CHOOSE_REMEDY)


def relabel(session: Session, shot: CaptureSlotRow, to: Slot, at: datetime, by: str | None) -> None:
    """Write the new eye and slot into the rows, and the move (old eye and slot, new eye, time, screen) into the report.

    `by`: public name of the screen that requested the move; None for the instrument's own button or a script.
    The files of the capture stay unchanged, but for its record (record_document.py). The dose of the capture is added
    once to the new eye and stays counted for the other eye too, because the correction may be wrong.
    """
    row = session.get_one(CaptureRow, shot.capture)
    from_eye = _eye(row)
    correction = EyeCorrection(from_eye, shot.slot, to.eye, at.isoformat(), by)
    report = _report(row).with_correction(to.id, correction)
    counted = {from_eye, *(move.from_eye for move in report.moved)}
    if to.eye not in counted:
        add_given_dose(session, to.eye, report.dose_j_per_cm2 or 0.0)
    row.eye = to.eye
    row.report = schema.report_text(report)
    shot.slot = to.id


def _eye(row: CaptureRow) -> Eye:
    """Return the eye of a capture; StoreDamaged if it cannot be read."""
    with row_validation.reading_record(row.id):
        return row_validation.one_of(row.eye, *EYES)


def _report(row: CaptureRow) -> CaptureReport:
    """Return the report of a capture; StoreDamaged if it cannot be read."""
    with row_validation.reading_record(row.id):
        return CaptureReport.parse(row.report)


def confirm(session: Session, shot: CaptureSlotRow, at: datetime, by: str | None) -> None:
    """Record in the report of a capture that its recorded eye is correct; `by` as in `relabel`.

    StoreDamaged if the report cannot be read.
    """
    row = session.get_one(CaptureRow, shot.capture)
    report = _report(row).with_confirmation(EyeConfirmation(row.eye, at.isoformat(), by))
    row.report = schema.report_text(report)
