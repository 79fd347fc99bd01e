"""Check of a whole store: every row against its digest and its file, and every file of a capture against its SHA-256.

Nothing is changed, so the check may run beside the instrument. What is healable is restored by the next start
(recovery.py), or by `diffuscope store rebuild`.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy.orm import Session

from services.errors import RecordErased, StoreDamaged
from services.records import blobs, record_signing, schema
from services.records.dose_ledger_log import DoseLedgerLog
from services.records.earlier_stores import require_store
from services.records.patient_keys import DEVICE, PatientKeys, ids_in_files
from services.records.record_document import Kind, RecordDocument
from services.records.record_files import RecordFiles
from services.records.recovery import damage_of
from services.records.removed_captures import MARK, is_large
from services.records.storage_errors import storage_errors

KINDS: dict[Kind, str] = {"patient": "patients", "visit": "visits", "capture": "captures"}
Progress = Callable[[str], None]


@dataclass
class Checked:
    """Result for one kind of content: the number of whole ones, and the names of the healable and the damaged ones."""

    name: str
    whole: int = 0
    healable: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        """Whether everything of this kind is whole."""
        return not self.healable and not self.damaged


def check_store(folder: Path, progress: Progress, key: bytes | None = None) -> list[Checked]:
    """Check the store in `folder` and return a result for each kind of content; `progress` gets one line per kind.

    `key`: authenticates its files; None checks no authenticity.

    RecordNotFound if the folder holds no store; StoreError if the disk refuses, or for an earlier store.
    """
    require_store(folder / schema.DATABASE)
    with storage_errors():
        progress("reading the database")
        database = _checked_database(folder)
        files = RecordFiles(folder, key)
        results = [database, _checked_ledger(folder, key)]
        documents = dict[tuple[Kind, str], RecordDocument]()
        for kind, name in KINDS.items():
            progress(f"reading the {name}")
            rows = _records_in_rows(folder, kind) if database.is_whole else ()
            results.append(_checked_records(folder, files, kind, rows, documents))
        results.append(_checked_keys(folder, [id for kind, id in documents if kind == "patient"]))
        progress("reading the files of the captures")
        results.append(_checked_files(folder, documents, key))
    return results


def _checked_database(folder: Path) -> Checked:
    result = Checked("database")
    damage = damage_of(folder / schema.DATABASE)
    if damage is None:
        result.whole = 1
    elif RecordFiles(folder).exist():
        result.healable.append(damage)
    else:
        result.damaged.append(damage)
    return result


def _checked_ledger(folder: Path, key: bytes | None) -> Checked:
    result = Checked("copy of the dose ledger")
    if DoseLedgerLog(folder, key).newest() is None:
        result.healable.append("no valid entry")
    else:
        result.whole = 1
    return result


def _checked_keys(folder: Path, patients: list[str]) -> Checked:
    """Look for the key of the device and of each patient in both files; one that is in neither is damaged."""
    result, (first, second) = Checked("keys of patients"), ids_in_files(folder)
    for id in (DEVICE, *patients):
        if id in first and id in second:
            result.whole += 1
        else:
            (result.healable if id in first or id in second else result.damaged).append(id or "the device")
    return result


def _checked_records(
    folder: Path,
    files: RecordFiles,
    kind: Kind,
    rows: Iterable[tuple[str, RecordDocument | None]],
    documents: dict[tuple[Kind, str], RecordDocument],
) -> Checked:
    """Compare rows and files of all records of a kind; add the newest whole state of each to `documents`."""
    result = Checked(KINDS[kind])
    known = set[str]()
    for id, in_rows in rows:
        known.add(id)
        in_file = _in_file(files, kind, id)
        whole = [document for document in (in_rows, in_file) if document is not None]
        if not whole:
            result.damaged.append(id)
            continue
        documents[kind, id] = max(whole, key=lambda document: document.revision)
        if len(whole) == 2 and whole[0].sha256() == whole[1].sha256():
            result.whole += 1
        else:
            result.healable.append(id)
    for id in files.ids(kind):
        if id not in known:
            in_file = _in_file(files, kind, id)
            (result.damaged if in_file is None else result.healable).append(id)
            if in_file is not None:
                documents[kind, id] = in_file
    return result


def _records_in_rows(folder: Path, kind: Kind) -> Iterator[tuple[str, RecordDocument | None]]:
    """Yield the id of each record that has rows, and its document; None if the rows are damaged."""
    engine = schema.open_engine(folder / schema.DATABASE)
    try:
        with Session(engine) as session:
            for page in record_signing.pages_of_keys(session, kind):
                whole = {record.id: record for record in record_signing.documents_of(session, kind, page)}
                for row in record_signing.rows_of(session, kind, page):
                    yield schema.record_key(row), whole.get(schema.record_key(row))
    finally:
        engine.dispose()


def _in_file(files: RecordFiles, kind: Kind, id: str) -> RecordDocument | None:
    try:
        return files.read(kind, id)
    except StoreDamaged:
        return None


def _checked_files(folder: Path, documents: dict[tuple[Kind, str], RecordDocument], key: bytes | None) -> Checked:
    """Decrypt each file of each whole capture record, and compare it with its SHA-256; erased ones are left out."""
    keys = PatientKeys(folder, key, readonly=True)
    result = Checked("files of captures")
    for (kind, id), document in documents.items():
        files = document.content.get("files")
        for name, described in files.items() if kind == "capture" and isinstance(files, dict) else ():
            try:
                content = blobs.read_file(folder / "captures" / id / Path(name).name, keys)
            except RecordErased:
                continue
            except StoreDamaged:
                result.damaged.append(f"{id}/{name}")
                continue
            except OSError:
                if not is_large(name) or not (folder / "captures" / id / MARK).exists():
                    result.damaged.append(f"{id}/{name}")
                continue
            expected = described.get("sha256") if isinstance(described, dict) else None
            if hashlib.sha256(content).hexdigest() == expected:
                result.whole += 1
            else:
                result.damaged.append(f"{id}/{name}")
    return result
