"""Values of patients in the tables, encrypted under their keys, and an index of the patient numbers in memory.

SQL can neither search nor compare encrypted numbers. A keyed digest in a column would do for the exact number only, and
would outlast the key of a patient who is erased.
"""

import base64
import json
from collections.abc import Mapping
from threading import Lock

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from device.errors import StoreError
from services.records import row_validation
from services.records.json_values import JsonObject, JsonValue
from services.records.patient_keys import PatientKeys
from services.records.record_document import as_object
from services.records.row_validation import reading_record
from services.records.schema import PatientRow

NUMBER = "number"  # entry of the identity beside the identifying fields of `answers.IDENTIFIERS`


class PatientIndex:
    """Encrypts and decrypts values of patients, and finds patients by number; thread-safe. `keys`: of the store."""

    def __init__(self, keys: PatientKeys) -> None:
        self.keys = keys
        self._lock = Lock()
        self._known: Mapping[str, tuple[str, str | None]] = {}  # encrypted identity and number by patient id

    def encrypted(self, patient_id: str, value: object) -> str:
        """Return a value of JSON as encrypted text (base64); RecordErased or StoreDamaged without the patient's key."""
        content = self.keys.encrypt(patient_id, json.dumps(value).encode(), "row")
        return base64.b64encode(content).decode()

    def decrypted(self, patient_id: str, stored: object) -> JsonValue:
        """Return the value of such a text; RecordErased, or StoreDamaged if it or the key is damaged."""
        with reading_record(patient_id):
            content = base64.b64decode(row_validation.text(stored), validate=True)
            return row_validation.parsed_json(self.keys.decrypt(patient_id, content, "row").decode())

    def identity(self, patient_id: str, stored: object) -> tuple[str, JsonObject]:
        """Return number and identifying fields of a patient from the column `identity`; errors as in `decrypted`."""
        with reading_record(patient_id):
            values = as_object(self.decrypted(patient_id, stored))
            fields = {name: value for name, value in values.items() if name != NUMBER}
            return row_validation.text(values[NUMBER]), fields

    def numbers(self, session: Session) -> dict[str, str]:
        """Return the number of each patient by patient id; without patients whose identity cannot be read.

        Only identities that differ from those of the last call are decrypted, whichever process changed them.
        """
        rows = session.execute(select(PatientRow.patient_id, PatientRow.identity)).all()
        with self._lock:
            self._known = {id: self._entry(id, identity) for id, identity in rows}
            return {id: number for id, (_, number) in self._known.items() if number is not None}

    def _entry(self, patient_id: str, identity: str) -> tuple[str, str | None]:
        known = self._known.get(patient_id)
        if known is not None and known[0] == identity:
            return known
        try:
            return identity, self.identity(patient_id, identity)[0]
        except StoreError:
            return identity, None


def use_keys(engine: Engine, keys: PatientKeys) -> None:
    """Let `index_of` return an index of these keys for the sessions of an engine."""
    engine.update_execution_options(patients=PatientIndex(keys))


def index_of(session: Session) -> PatientIndex:
    """Return the index of the patients of the store whose tables a session reads."""
    index: PatientIndex = session.get_bind().get_execution_options()["patients"]
    return index
