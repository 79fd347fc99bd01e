"""Rows of patients: the number of a known or new patient, the counter of automatic numbers, the patient of a visit."""

import secrets

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from device.errors import InputError
from services.errors import RecordNotFound
from services.records import numbering, schema
from services.records.schema import CounterRow, PatientRow, VisitRow
from services.records.storage_errors import storage_errors


def patient_number(session: Session, prefix: str, number: str | None, made_at: str) -> str:
    """Return the patient's number (None: the next automatic one), creating the patient if new, at `made_at`.

    An unknown number that is known with a prefix before it gets the prefix: the `prefix` of the programme first, then
    those that this device used earlier. InputError for a number in the form of an automatic one with a wrong check
    digit.
    """
    if number is None:
        number = _next_number(session, prefix)
    elif session.get(PatientRow, number) is None:
        prefixes = [prefix, *(earlier for earlier in session.scalars(select(CounterRow.prefix)) if earlier != prefix)]
        known = next(
            (start + number for start in prefixes if session.get(PatientRow, start + number) is not None), None
        )
        if known is None and any(_is_mistyped(start, number) for start in prefixes):
            raise InputError(f"number: {number} is mistyped: its last digit does not fit", "Type the number again.")
        number = known or number
    if session.get(PatientRow, number) is None:
        patient_id = secrets.token_hex(8)
        schema.patient_keys_of(session.get_bind()).create(patient_id)
        session.add(PatientRow(number=number, made_at=made_at, patient_id=patient_id))
        session.flush()
    return number


def patient_of_visit(engine: Engine, visit: str | None) -> str:
    """Return the id of the patient of a visit, "" without a visit; RecordNotFound if the visit is unknown."""
    if visit is None:
        return ""
    query = select(PatientRow.patient_id).join(VisitRow, VisitRow.patient == PatientRow.number)
    with storage_errors(), Session(engine) as session:
        patient_id = session.scalar(query.where(VisitRow.id == visit))
    if patient_id is None:
        raise RecordNotFound(f"there is no visit named {visit!r}")
    return patient_id


def _is_mistyped(prefix: str, number: str) -> bool:
    return numbering.looks_automatic(prefix, number) and not numbering.has_valid_check_digit(prefix, number)


def _next_number(session: Session, prefix: str) -> str:
    """Return the next automatic number of the prefix that no patient has, and advance the counter."""
    counter = session.get(CounterRow, prefix) or CounterRow(prefix=prefix, last=0)
    session.add(counter)
    while True:
        counter.last += 1
        if session.get(PatientRow, number := numbering.automatic_number(prefix, counter.last)) is None:
            return number
