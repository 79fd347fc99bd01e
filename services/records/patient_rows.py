"""Rows of patients: encrypted values, a known or new patient by number or visit, and the counter of numbers."""

import base64
import json
import secrets
from collections.abc import Collection
from contextlib import suppress

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from device.errors import InputError, StoreError
from services.errors import RecordNotFound, StoreDamaged
from services.records import numbering, row_validation
from services.records.json_values import FormValue, JsonValue
from services.records.patient_keys import PatientKeys
from services.records.record_document import as_object
from services.records.row_validation import REMEDY, reading_record
from services.records.schema import CounterRow, PatientRow, VisitRow
from services.records.storage_errors import storage_errors

NUMBER = "number"  # entry of the identity beside the identifying fields of `answers.IDENTIFIERS`
ENDINGS = ("", *(f"-{count}" for count in range(2, 100)))  # of patients who got one number after restorations


class PatientIndex:
    """Encrypts values of patients under their keys, and finds numbers, which SQL cannot search; thread-safe."""

    def __init__(self, keys: PatientKeys) -> None:
        self.keys = keys
        self._numbers = dict[tuple[str, str], str | None]()  # by patient id and encrypted identity; replaced as a whole

    def encrypted(self, patient_id: str, value: object) -> str:
        """Return a value of JSON as encrypted text (base64); RecordErased or StoreDamaged without the patient's key."""
        return base64.b64encode(self.keys.encrypt(patient_id, json.dumps(value).encode(), "row")).decode()

    def decrypted(self, patient_id: str, stored: object) -> JsonValue:
        """Return the value of such a text; RecordErased, or StoreDamaged if it or the key is damaged."""
        with reading_record(patient_id):
            content = base64.b64decode(row_validation.text(stored), validate=True)
            return row_validation.parsed_json(self.keys.decrypt(patient_id, content, "row").decode())

    def identity(self, patient_id: str, stored: object) -> tuple[str, dict[str, JsonValue]]:
        """Return number and identifying fields of a patient from the column `identity`; errors as in `decrypted`."""
        with reading_record(patient_id):
            values = as_object(self.decrypted(patient_id, stored))
            fields = {name: value for name, value in values.items() if name != NUMBER}
            return row_validation.text(values[NUMBER]), fields

    def numbers(self, session: Session) -> dict[str, str]:
        """Return the readable numbers by patient id; only new identities are decrypted, of any process.

        Those of patients whom any process erased are forgotten.
        """
        rows = session.execute(select(PatientRow.patient_id, PatientRow.identity)).all()
        known, erased = self._numbers, self.keys.erased
        entries = [(id, identity) for id, identity in rows if id not in erased]
        numbers = {entry: known[entry] if entry in known else self._read_number(*entry) for entry in entries}
        self._numbers = numbers
        return {id: number for (id, _), number in numbers.items() if number is not None}

    def _read_number(self, patient_id: str, identity: str) -> str | None:
        with suppress(StoreError):
            return self.identity(patient_id, identity)[0]
        return None


def index_of(session: Session) -> PatientIndex:
    """Return the index that `CaptureStore` gives to the engine of its tables."""
    index: PatientIndex = session.get_bind().get_execution_options()["patients"]
    return index


def identity(session: Session, id: str) -> tuple[str, dict[str, JsonValue]]:
    """Return number and identifying fields of a patient; RecordErased, StoreDamaged (also without a row)."""
    row = session.get(PatientRow, id)
    if row is None:
        raise StoreDamaged("the entry of a patient is missing", REMEDY)
    return index_of(session).identity(id, row.identity)


def set_field(session: Session, id: str, name: str, value: FormValue) -> JsonValue:
    """Set an identifying field of a patient, None to remove it; return its value before. Errors as in `identity`."""
    number, fields = identity(session, id)
    kept = {key: known for key, known in {NUMBER: number, **fields, name: value}.items() if known is not None}
    session.get_one(PatientRow, id).identity = index_of(session).encrypted(id, kept)
    return fields.get(name)


def add_patient(session: Session, id: str, number: str, made_at: str) -> None:
    """Add a patient with a key; RecordErased if a patient with this id was erased."""
    index = index_of(session)
    index.keys.create(id)
    session.add(PatientRow(patient_id=id, made_at=made_at, identity=index.encrypted(id, {NUMBER: number})))
    session.flush()


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
    if number not in known:
        known[number] = secrets.token_hex(8)
        add_patient(session, known[number], number, made_at)
    return known[number]


def give_free_number(session: Session, row: PatientRow) -> bool:
    """Give a patient whose row is restored a free number; return whether the number could stay.

    If another patient has it, as after the restoration of older tables, it gets the first free of ENDINGS: two patients
    are never mixed up. An identity that cannot be decrypted stays as it is.
    """
    index, id = index_of(session), row.patient_id
    if "taken" not in session.info:  # read once in a transaction, which holds the write lock
        session.info["taken"] = {number: known for known, number in index.numbers(session).items()}
    taken: dict[str, str] = session.info["taken"]
    try:
        described, fields = index.identity(id, row.identity)
    except StoreError:
        return True
    candidates = (numbering.with_ending(described, ending) for ending in ENDINGS)
    [number, *_] = (candidate for candidate in candidates if taken.get(candidate, id) == id)  # else ValueError
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
