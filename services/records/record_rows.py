"""Contents of records from database rows, and rows from contents: patients, visits, captures.

A record holds raw values of its rows, so that content read from restored rows is the same again. The captures of a
visit are not in its record: each capture's own record names visit and slot.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from datetime import date
from typing import Any, TypeVar

from sqlalchemy import Row, delete, select
from sqlalchemy.dialects.sqlite import insert
from sqlalchemy.orm import Session

from device.values import EYES
from services.records import numbering, row_validation
from services.records.capture import CaptureReport
from services.records.json_values import JsonObject, JsonValue
from services.records.patient_rows import add_patient, give_free_number
from services.records.record_document import Kind, as_list, as_object, whole_number
from services.records.schema import (
    AnswerRow,
    CaptureRow,
    CaptureSlotRow,
    ChangeRow,
    FileRow,
    IdempotencyKeyRow,
    PatientRow,
    SlotDecisionRow,
    UploadRow,
    VisitRow,
)

CAPTURE_VALUES = ("eye", "taken_at", "simulated", "calibration_id", "report", "request")
Content = dict[str, JsonValue]
R = TypeVar("R", PatientRow, VisitRow)
FileEntry = tuple[Any, Any, Any]  # name, SHA-256 and length of a file, as the row has them


def file_entries(row: CaptureRow) -> list[FileEntry]:
    """Return name, SHA-256 and length of each file of a capture."""
    return [(file.name, file.sha256, file.bytes) for file in row.files]


def capture_content(row: CaptureRow | Row[*tuple[Any, ...]], files: Iterable[FileEntry]) -> Content:
    """Return the content of the record of a capture from its row and (name, SHA-256, length) of its files.

    ValueError or TypeError if a value is no JSON.
    """
    return {
        "id": row.id,
        "eye": row.eye,
        "taken_at": row.taken_at,
        "simulated": row.simulated,
        "calibration_id": row.calibration_id,
        "request": row.request,
        "report": _parsed(row.report),
        "files": {name: {"sha256": digest, "bytes": length} for name, digest, length in files},
    }


def patient_contents(rows: Sequence[PatientRow]) -> dict[str, Content | ValueError]:
    """Return the content of each patient by id, or the error of reading its row; its identity stays encrypted."""

    def content(row: PatientRow) -> Content:
        return {"id": row.patient_id, "made_at": row.made_at, "identity": row_validation.text(row.identity)}

    return {row.patient_id: _or_error(content, row) for row in rows}


def visit_contents(session: Session, rows: Sequence[VisitRow]) -> dict[str, Content | ValueError]:
    """Return the content of each visit by id, or the error of reading its rows."""
    ids = row_validation.readable_keys(row.id for row in rows)
    answered = session.scalars(select(AnswerRow).where(AnswerRow.visit.in_(ids)))
    answers = _grouped((row.visit, row.name, (row.value, row.set_at)) for row in answered if row is not None)
    decided = session.scalars(select(SlotDecisionRow).where(SlotDecisionRow.visit.in_(ids)))
    slots = _grouped((row.visit, row.slot, (row.capture, row.reason)) for row in decided if row is not None)
    changed = session.scalars(select(ChangeRow).where(ChangeRow.visit.in_(ids)).order_by(ChangeRow.number))
    changes = _grouped((row.visit, row.field, row) for row in changed if row is not None)
    sent = session.scalars(select(UploadRow).where(UploadRow.visit.in_(ids), UploadRow.sent_at.is_not(None)))
    uploads = _grouped((row.visit, row.finished_at, row) for row in sent if row is not None)

    def content(row: VisitRow) -> Content:
        history: Content = {}
        if changes[row.id]:
            history["changes"] = [_change_content(change) for _, change in changes[row.id]]
        return history | {
            "id": row.id,
            "patient_id": row.patient,
            "day": row.day,
            "begun_at": row.begun_at,
            "finished_at": row.finished_at,
            "outcome": None if row.outcome is None else _parsed(row.outcome),
            "sent": row.sent,
            "request": row.request,
            "answers": {name: {"value": _parsed(value), "set_at": at} for name, (value, at) in answers[row.id]},
            "decisions": {slot: {"capture": capture, "reason": why} for slot, (capture, why) in slots[row.id]},
            "uploads": {at: _upload_content(upload) for at, upload in uploads[row.id]},
        }

    return {row.id: _or_error(content, row) for row in rows}


def restore_patient(session: Session, content: JsonObject) -> bool:
    """Write the row of a patient as described; return whether the number could stay (`give_free_number`).

    ValueError, TypeError or KeyError for a content of another form.
    """
    row = _patient_row(content)
    as_described = give_free_number(session, row)
    session.merge(row)
    session.flush()
    return as_described


def restore_visit(session: Session, content: JsonObject) -> bool:
    """Write the rows of a visit as described, but its decisions on slots; return whether its patient has a row.

    A patient without one gets one with the patient id as number and no identifying field. Errors as in
    `restore_patient`; RecordErased if such a patient was erased.
    """
    row, answers, changes, uploads, _ = _visit_rows(content)
    is_known = session.get(PatientRow, row.patient) is not None
    if not is_known:
        add_patient(session, row.patient, row.patient[: numbering.MAX_LENGTH].upper(), row.begun_at)
    session.execute(delete(AnswerRow).where(AnswerRow.visit == row.id))
    session.execute(delete(ChangeRow).where(ChangeRow.visit == row.id))
    session.execute(delete(UploadRow).where(UploadRow.visit == row.id, UploadRow.sent_at.is_not(None)))
    _restore_request(session, row.request, row.id, row.begun_at)
    session.merge(row)
    session.flush()
    session.add_all([*answers, *changes])
    for upload in uploads:
        session.merge(upload)
    session.flush()
    return is_known


def restore_decisions(session: Session, content: JsonObject) -> list[str]:
    """Write the decisions on the slots of a visit; return the ids of chosen captures that have no row.

    A decision on such a capture is omitted: its files and its record are gone.
    """
    row, _, _, _, decisions = _visit_rows(content)
    session.execute(delete(SlotDecisionRow).where(SlotDecisionRow.visit == row.id))
    chosen = {decision.capture for decision in decisions if decision.capture is not None}
    present = set(session.scalars(select(CaptureRow.id).where(CaptureRow.id.in_(chosen))))
    session.add_all(decision for decision in decisions if decision.capture is None or decision.capture in present)
    session.flush()
    return sorted(chosen - present)


def refuse_invalid(kind: Kind, content: JsonObject) -> None:
    """Raise ValueError, TypeError or KeyError if the content is none from which the rows can be restored."""
    {"patient": _patient_row, "visit": _visit_rows, "capture": capture_row}[kind](content)


def capture_row(content: JsonObject) -> CaptureRow:
    """Return the row of a capture as described, with its file rows; errors as in `restore_patient`."""
    files = as_object(content["files"])
    if not files:
        raise ValueError("a capture without files")
    report = as_object(content["report"])
    CaptureReport.read(report)
    return CaptureRow(
        id=row_validation.text(content["id"]),
        eye=row_validation.one_of(content["eye"], *EYES),
        taken_at=_moment(content["taken_at"]),
        simulated=row_validation.one_of(content["simulated"], 0, 1),
        calibration_id=row_validation.text(content["calibration_id"]),
        request=_text_or_none(content["request"]),
        report=json.dumps(report, allow_nan=False),
        files=[_file_row(name, as_object(file)) for name, file in files.items()],
    )


def restore_capture(session: Session, row: CaptureRow) -> None:
    """Write the rows of a capture, its files and the idempotency key of its press, instead of those present."""
    session.execute(delete(FileRow).where(FileRow.capture_id == row.id))
    values = {name: getattr(row, name) for name in CAPTURE_VALUES}
    session.execute(insert(CaptureRow).values(id=row.id, **values).on_conflict_do_update(["id"], set_=values))
    files = [dict(zip(("name", "sha256", "bytes"), file, strict=True)) for file in file_entries(row)]
    session.execute(insert(FileRow), [{"capture_id": row.id, **file} for file in files])
    _restore_request(session, row.request, row.id, row.taken_at)


def restore_slots(session: Session) -> list[str]:
    """Write visit and slot of each capture as its report has them, for known visits; return the ids of those changed.

    The report is what the record of the capture holds, so that a lost or changed row of `capture_slots` is found.
    """
    query = (
        select(CaptureRow.id, CaptureRow.visit, CaptureRow.slot, CaptureSlotRow)
        .join(VisitRow, VisitRow.id == CaptureRow.visit)
        .outerjoin(CaptureSlotRow, CaptureSlotRow.capture == CaptureRow.id)
        .where(CaptureRow.slot.is_not(None))
    )
    changed = []
    for id, visit, slot, present in session.execute(query).all():
        if present is None or (present.visit, present.slot) != (visit, slot):
            session.merge(CaptureSlotRow(capture=id, visit=visit, slot=slot))
            changed.append(id)
    session.flush()
    return changed


def _restore_request(session: Session, request: str | None, answer: str, at: str) -> None:
    """Write the idempotency key of the request that made a record, so that a repeat has no further effect."""
    if request is not None:
        key, digest = request.split(" ")
        session.merge(IdempotencyKeyRow(key=key, request=digest, answer=answer, done_at=at))


def _patient_row(content: JsonObject) -> PatientRow:
    """Return the row that the content of a patient describes."""
    id, identity = (row_validation.text(content[name]) for name in ("id", "identity"))
    return PatientRow(patient_id=id, made_at=_moment(content["made_at"]), identity=identity)


def _visit_rows(
    content: JsonObject,
) -> tuple[VisitRow, list[AnswerRow], list[ChangeRow], list[UploadRow], list[SlotDecisionRow]]:
    """Return the rows that the content of a visit describes."""
    id = row_validation.text(content["id"])
    outcome = content["outcome"]
    finished_at, sent, request = (_text_or_none(content[name]) for name in ("finished_at", "sent", "request"))
    row = VisitRow(
        id=id,
        patient=row_validation.text(content["patient_id"]),
        day=_day(content["day"]),
        begun_at=_moment(content["begun_at"]),
        finished_at=None if finished_at is None else _moment(finished_at),
        outcome=None if outcome is None else json.dumps(as_object(outcome)),
        sent=sent,
        request=request,
    )
    answers = [(row_validation.text(name), as_object(answer)) for name, answer in as_object(content["answers"]).items()]
    changes = [_change_row(id, as_object(change)) for change in as_list(content.get("changes", []))]
    uploads = [_upload_row(id, at, as_object(upload)) for at, upload in as_object(content["uploads"]).items()]
    return (
        row,
        [
            AnswerRow(
                visit=id, name=name, value=json.dumps(answer["value"]), set_at=row_validation.text(answer["set_at"])
            )
            for name, answer in answers
        ],
        changes,
        uploads,
        [_decision_row(id, slot, as_object(decision)) for slot, decision in as_object(content["decisions"]).items()],
    )


def _decision_row(visit: str, slot: str, decision: JsonObject) -> SlotDecisionRow:
    capture, reason = (_text_or_none(decision[name]) for name in ("capture", "reason"))
    return SlotDecisionRow(visit=visit, slot=row_validation.text(slot), capture=capture, reason=reason)


def _change_content(row: ChangeRow) -> Content:
    texts: Content = {"number": row.number, "at": row.at, "user": row.user, "field": row.field, "why": row.why}
    return texts | {"was": _parsed(row.was), "value": _parsed(row.value)}


def _change_row(visit: str, change: JsonObject) -> ChangeRow:
    return ChangeRow(
        visit=visit,
        number=whole_number(change["number"]),
        at=_moment(change["at"]),
        user=row_validation.text(change["user"]),
        field=row_validation.text(change["field"]),
        was=json.dumps(change["was"]),
        value=json.dumps(change["value"]),
        why=_text_or_none(change["why"]),
    )


def _upload_content(row: UploadRow) -> Content:
    return {"tries": row.tries, "sent_at": row.sent_at, "sha256": row.sha256, "confirmed": row.confirmed}


def _upload_row(visit: str, finished_at: str, upload: JsonObject) -> UploadRow:
    sent_at, sha256, confirmed = (row_validation.text(upload[name]) for name in ("sent_at", "sha256", "confirmed"))
    tries = whole_number(upload["tries"])
    return UploadRow(
        visit=visit, finished_at=finished_at, tries=tries, sent_at=sent_at, sha256=sha256, confirmed=confirmed
    )


def _file_row(name: str, file: JsonObject) -> FileRow:
    digest = row_validation.text(file["sha256"])
    length = whole_number(file["bytes"])
    return FileRow(name=row_validation.text(name), sha256=digest, bytes=length)


def _parsed(value: object) -> JsonValue:
    return row_validation.parsed_json(value)


def _text_or_none(value: object) -> str | None:
    return None if value is None else row_validation.text(value)


def _day(value: object) -> str:
    date.fromisoformat(row_validation.text(value))
    return row_validation.text(value)


def _moment(value: object) -> str:
    """Return the text of a timestamp unchanged; ValueError if it is none."""
    row_validation.timestamp(value)
    return row_validation.text(value)


def _grouped(rows: Iterable[tuple[str, str, Any]]) -> dict[str, list[tuple[str, Any]]]:
    """Return (name, value) pairs by record from (record, name, value) triples."""
    out: dict[str, list[tuple[str, Any]]] = defaultdict(list)
    for record, name, value in rows:
        out[record].append((name, value))
    return out


def _or_error(read: Callable[[R], Content], row: R) -> Content | ValueError:
    try:
        return read(row)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        return ValueError(str(error))
