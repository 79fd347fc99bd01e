"""Rows of patients: by number or visit, the encrypted identity, and the counter of automatic numbers."""

import secrets
from collections.abc import Collection

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from device.errors import InputError, StoreError
from services.errors import RecordNotFound, StoreDamaged
from services.records import numbering
from services.records.json_values import FormValue, JsonObject, JsonValue
from services.records.patient_index import NUMBER, index_of
from services.records.row_validation import REMEDY
from services.records.schema import CounterRow, PatientRow, VisitRow
from services.records.storage_errors import storage_errors

MAX_OF_ONE_NUMBER = 99  # patients that got the same number after restorations of older tables


def patient_of_number(session: Session, prefix: str, number: str | None, made_at: str) -> str:
    """Return the id of the patient with a number (None: the next automatic one), creating a new one, at `made_at`.

    An unknown number that is known with a prefix before it is that patient's: the `prefix` of the programme first, then
    those that this device used earlier. InputError for a number in the form of an automatic one with a wrong check
    digit.
    """
    known = {taken: id for id, taken in index_of(session).numbers(session).items()}
    if number is None:
        number = _next_number(session, prefix, known)
    elif number not in known:
        prefixes = [prefix, *(earlier for earlier in session.scalars(select(CounterRow.prefix)) if earlier != prefix)]
        with_prefix = next((start + number for start in prefixes if start + number in known), None)
        if with_prefix is None and any(_is_mistyped(start, number) for start in prefixes):
            raise InputError(f"number: {number} is mistyped: its last digit does not fit", "Type the number again.")
        number = with_prefix or number
    if number in known:
        return known[number]
    id = secrets.token_hex(8)
    add_patient(session, id, number, made_at)
    return id


def add_patient(session: Session, id: str, number: str, made_at: str) -> None:
    """Add a patient with a key; RecordErased if a patient with this id was erased."""
    index = index_of(session)
    index.keys.create(id)
    session.add(PatientRow(patient_id=id, made_at=made_at, identity=index.encrypted(id, {NUMBER: number})))
    session.flush()


def identity(session: Session, id: str) -> tuple[str, JsonObject]:
    """Return number and identifying fields of a patient.

    RecordErased, or StoreDamaged if the patient has no row, or row or key are damaged.
    """
    row = session.get(PatientRow, id)
    if row is None:
        raise StoreDamaged(f"the entry of the patient {id!a} is missing", REMEDY)
    return index_of(session).identity(id, row.identity)


def set_field(session: Session, id: str, name: str, value: FormValue) -> JsonValue:
    """Set an identifying field of a patient, None to remove it; return its value before. Errors as in `identity`."""
    number, fields = identity(session, id)
    kept: dict[str, object] = {NUMBER: number, **fields, name: value}
    row = session.get_one(PatientRow, id)
    row.identity = index_of(session).encrypted(id, {key: known for key, known in kept.items() if known is not None})
    return fields.get(name)


def give_free_number(session: Session, row: PatientRow) -> bool:
    """Give a patient whose row is restored a free number; return whether the number could stay.

    If another patient has it, as after the restoration of older tables, it gets the first free of the endings "-2",
    "-3", ...: two patients are never mixed up. An identity that cannot be decrypted stays as it is.
    """
    index, id = index_of(session), row.patient_id
    taken: dict[str, str] = session.info.get("taken") or {
        number: known for known, number in index.numbers(session).items()
    }
    session.info["taken"] = taken  # read once in a transaction, which holds the write lock
    try:
        described, fields = index.identity(id, row.identity)
    except StoreError:
        return True
    endings = ("", *(f"-{count}" for count in range(2, MAX_OF_ONE_NUMBER + 1)))
    candidates = (numbering.with_ending(described, ending) for ending in endings)
    number = next((candidate for candidate in candidates if taken.get(candidate, id) == id), None)
    if number is None:
        raise ValueError(f"{MAX_OF_ONE_NUMBER} patients have the same number as {id}")
    taken[number] = id
    if number != described:
        row.identity = index.encrypted(id, {NUMBER: number, **fields})
    return number == described


def patient_of_visit(engine: Engine, visit: str | None) -> str:
    """Return the id of the patient of a visit, "" without a visit; RecordNotFound if the visit is unknown."""
    if visit is None:
        return ""
    with storage_errors(), Session(engine) as session:
        patient_id = session.scalar(select(VisitRow.patient).where(VisitRow.id == visit))
    if patient_id is None:
        raise RecordNotFound(f"there is no visit named {visit!r}")
    return patient_id


def _is_mistyped(prefix: str, number: str) -> bool:
    return numbering.looks_automatic(prefix, number) and not numbering.has_valid_check_digit(prefix, number)


def _next_number(session: Session, prefix: str, known: Collection[str]) -> str:
    """Return the next automatic number of the prefix that no patient has, and advance the counter."""
    counter = session.get(CounterRow, prefix) or CounterRow(prefix=prefix, last=0)
    session.add(counter)
    while True:
        counter.last += 1
        if (number := numbering.automatic_number(prefix, counter.last)) not in known:
            return number
