"""Rows of patients: the number of a known or new patient, and the counter of automatic numbers."""

from sqlalchemy.orm import Session

from device.errors import InputError
from services.records import numbering
from services.records.schema import CounterRow, PatientRow


def patient_number(session: Session, prefix: str, number: str | None, made_at: str) -> str:
    """Return the patient's number (None: the next automatic one), creating the patient if new, at `made_at`.

    An unknown number that is known with the `prefix` of the programme before it gets the prefix. InputError for a
    number in the form of an automatic one with a wrong check digit.
    """
    if number is None:
        number = _next_number(session, prefix)
    elif session.get(PatientRow, number) is None and session.get(PatientRow, prefix + number) is not None:
        number = prefix + number
    elif numbering.looks_automatic(prefix, number) and not numbering.has_valid_check_digit(prefix, number):
        raise InputError(f"number: {number} is mistyped: its last digit does not fit", "Type the number again.")
    if session.get(PatientRow, number) is None:
        session.add(PatientRow(number=number, made_at=made_at))
        session.flush()
    return number


def _next_number(session: Session, prefix: str) -> str:
    """Return the next automatic number of the prefix that no patient has, and advance the counter."""
    counter = session.get(CounterRow, prefix) or CounterRow(prefix=prefix, last=0)
    session.add(counter)
    while True:
        counter.last += 1
        if session.get(PatientRow, number := numbering.automatic_number(prefix, counter.last)) is None:
            return number
