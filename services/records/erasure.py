"""Erasure of patients: the key first, then the files, the rows last; the next opening finishes what was interrupted.

    erasures.jsonl     list of erasures, one line each: patient id and receipt

Once the key is overwritten, no copy of name, number or pictures can be decrypted: neither in a backup or a snapshot of
the tables, nor in free blocks of the disk. Older copies of the tables stay: what they still show has a random patient
id. A row whose patient is in the list, or whose key is erased, is a restored or an unfinished one: it is erased again.
"""

import hashlib
import hmac
import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError
from sqlalchemy import Engine, delete, func, select
from sqlalchemy.orm import Session

from device import atomic_io
from device.errors import InputError, StoreError
from device.user_files import files_in
from services.errors import RecordNotFound, StoreDamaged
from services.records import blobs, digested_json, numbering, schema
from services.records.device_identity import read_device
from services.records.json_values import Timestamp
from services.records.patient_keys import PatientKeys
from services.records.patient_rows import index_of
from services.records.reserve_file import ReserveFile
from services.records.schema import CaptureRow, FileRow, IdempotencyKeyRow, PatientRow, VisitRow
from services.records.storage_errors import storage_errors
from services.records.visit import EraseReason

log = logging.getLogger(__name__)

LIST = "erasures.jsonl"


class ErasureReceipt(BaseModel):
    """Receipt of an erasure, without name and number: HMAC-SHA-256 of the patient id, UUID of the device, counts, time.

    `files`: number of files of the captures. `mac`: HMAC-SHA-256 of the other entries with the store's key.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    patient: str
    device: str
    erased_at: Timestamp
    reason: EraseReason
    visits: int
    captures: int
    files: int
    mac: str = ""

    def sealed(self, key: bytes | None) -> "ErasureReceipt":
        """Return the receipt with the `mac` of its other entries, which differs from its own if one was changed."""
        entries = json.dumps(self.model_dump(mode="json", exclude={"mac"}), sort_keys=True)
        return self.model_copy(update={"mac": _digest(key, "receipt", entries)})


class PatientRecords(NamedTuple):
    """What is stored of a patient: ids of visits and captures, and the number of files of the captures."""

    patient_id: str
    visits: Sequence[str]
    captures: Sequence[str]
    files: int


class Erasures:
    """Erasures of patients in the store with these tables and keys; `lock`: lock file of the writers. Thread-safe."""

    def __init__(self, engine: Engine, keys: PatientKeys, lock: Path) -> None:
        self._engine, self._keys, self._lock = engine, keys, lock
        self._folder, self._key = schema.folder_of(engine), schema.key_of(engine)

    def find(self, number: str) -> PatientRecords:
        """Return what is stored of the patient with a number; RecordNotFound without one, InputError if it is none."""
        wanted = numbering.normalise(number)
        with storage_errors(), Session(self._engine) as session:
            found = next((id for id, known in index_of(session).numbers(session).items() if known == wanted), None)
            if found is None:
                raise RecordNotFound("no patient has this number", "Type the number as the list of patients shows it.")
            return _records(session, found)

    def erase(self, number: str, reason: EraseReason, at: datetime) -> tuple[str, ErasureReceipt]:
        """Erase the patient with a number durably; return the patient id and the receipt.

        Errors: as in `find`; StoreReadOnly, StoreFull, StoreError: if the list has the patient already, the next
        opening finishes the erasure.
        """
        schema.refuse_if_read_only(self._engine)
        with storage_errors(), atomic_io.file_lock(self._lock):
            found = self.find(number)
            device = read_device(self._folder)
            counts = {"visits": len(found.visits), "captures": len(found.captures), "files": found.files}
            patient, uuid = _digest(self._key, "patient", found.patient_id), "" if device is None else device.uuid
            receipt = ErasureReceipt(patient=patient, device=uuid, erased_at=at, reason=reason, **counts)
            receipt = receipt.sealed(self._key)
            ReserveFile(self._folder).retried(partial(_append, self._folder, found.patient_id, receipt))
            self._keys.erase(found.patient_id)
            self._remove(found)
        return found.patient_id, receipt

    def finish(self) -> None:
        """Erase again what a restoration brought back or an interruption left; the caller holds the lock."""
        try:
            with storage_errors():
                for patient_id in listed(self._folder, self._key).keys() - self._keys.erased:
                    self._keys.erase(patient_id)
                with Session(self._engine) as session:
                    ids = [id for id in session.scalars(select(PatientRow.patient_id)) if id in self._keys.erased]
                    unfinished = [_records(session, id) for id in ids]
                for found in unfinished:
                    self._remove(found)
        except StoreError as error:
            log.error("an erasure was not finished, the next start tries again: %s", error)

    def _remove(self, found: PatientRecords) -> None:
        """Remove the files of a patient, and then the rows, by which the files of an interrupted erasure are found."""
        for path in _paths(self._folder, found):
            atomic_io.remove(path)
        os.sync()  # before the rows: a folder that a power cut brings back must still have a row
        with Session(schema.for_writing(self._engine)) as session, session.begin():
            _delete_rows(session, found)


def listed(folder: Path, key: bytes | None) -> dict[str, ErasureReceipt]:
    """Return the receipts in the list of a store by patient id, the oldest first; OSError if it cannot be read.

    A line that a power cut cut off, or that another program wrote, is left out.
    """
    path = folder / LIST
    receipts = dict[str, ErasureReceipt]()
    for line in path.read_bytes().splitlines() if path.exists() else ():
        with suppress(ValueError, KeyError, TypeError):
            entry = json.loads(line)
            patient_id, receipt = str(entry["patient_id"]), ErasureReceipt.model_validate(entry["receipt"])
            if receipt == receipt.sealed(key) and receipt.patient == _digest(key, "patient", patient_id):
                receipts[patient_id] = receipt
    return receipts


def carry_erasures(store: Path, key: bytes | None, restored: Path, restored_key: bytes | None) -> None:
    """Add the erasures of a store to the list of the restored files that will replace its own; OSError on failure."""
    known = listed(restored, restored_key)
    for id, receipt in listed(store, key).items():
        if id not in known:
            patient = _digest(restored_key, "patient", id)
            _append(restored, id, receipt.model_copy(update={"patient": patient}).sealed(restored_key))


def verified(content: bytes, key: bytes | None) -> ErasureReceipt:
    """Return a receipt from its file; InputError if it is none, StoreDamaged if this store did not write it so."""
    try:
        receipt = ErasureReceipt.model_validate_json(content)
    except ValidationError as error:
        raise InputError("this is no receipt of an erasure", "Give the file of a receipt.") from error
    if receipt != receipt.sealed(key):
        raise StoreDamaged(
            "the receipt was changed, or another device wrote it", "Ask for the receipt as it was written."
        )
    return receipt


def _append(folder: Path, patient_id: str, receipt: ErasureReceipt) -> None:
    """Add a line to the list, durable on return."""
    line = json.dumps({"patient_id": patient_id, "receipt": receipt.model_dump(mode="json")})
    with storage_errors():
        with open(folder / LIST, "ab", opener=atomic_io.private_opener) as file:
            file.write(f"\n{line}\n".encode())  # a torn line before it stays a line of its own
        atomic_io.fsync_file(folder / LIST)
        atomic_io.fsync_folder(folder)


def _digest(key: bytes | None, use: str, text: str) -> str:
    return hmac.new(key or b"", f"erasure {use}\0{text}".encode(), hashlib.sha256).hexdigest()


def _records(session: Session, patient_id: str) -> PatientRecords:
    visits = session.scalars(select(VisitRow.id).where(VisitRow.patient == patient_id)).all()
    captures = session.scalars(select(CaptureRow.id).where(CaptureRow.visit.in_(visits))).all()
    files = session.scalar(select(func.count()).select_from(FileRow).where(FileRow.capture_id.in_(captures))) or 0
    return PatientRecords(patient_id, visits, captures, files)


def _paths(folder: Path, found: PatientRecords) -> Iterator[Path]:
    """Yield all files and folders of a patient, that of the patient's record last.

    A folder of pictures is found by the patient's id in the header of its files, also without a row.
    """
    for path in files_in(folder, "captures/*", "quarantine/*", "removed/*", "journal/*"):
        is_own = blobs.patient_of(path) == found.patient_id if path.is_dir() else _visit_of(path) in found.visits
        if is_own or path.name in found.captures:
            yield path
    ids = [found.patient_id, *found.visits, *found.captures]
    yield from (path for path in files_in(folder, "conflicts/*") if any(f"-{id}-" in path.name for id in ids))
    names = [f"{place}/{visit}.json" for visit in found.visits for place in ("exports", "visits")]
    yield from (path for name in (*names, f"patients/{found.patient_id}.json") if (path := folder / name).exists())


def _visit_of(entry: Path) -> object:
    """Return the visit in an entry of the journal; None without one, or if it cannot be read."""
    with suppress(OSError, ValueError):
        return digested_json.decoded(entry.read_bytes()).get("visit")
    return None


def _delete_rows(session: Session, found: PatientRecords) -> None:
    of_visits = (schema.SlotDecisionRow, schema.CaptureSlotRow, schema.UploadRow, schema.AnswerRow, schema.ChangeRow)
    of_captures = (schema.SlotDecisionRow.capture, schema.CaptureSlotRow.capture, FileRow.capture_id, CaptureRow.id)
    conditions = [
        *(table.visit.in_(found.visits) for table in of_visits),
        *(column.in_(found.captures) for column in of_captures),
        *(IdempotencyKeyRow.answer.contains(id) for id in (*found.visits, *found.captures)),  # also of exports
        VisitRow.id.in_(found.visits),
        PatientRow.patient_id == found.patient_id,
    ]
    for condition in conditions:
        session.execute(delete(condition.left.table).where(condition).execution_options(synchronize_session=False))
