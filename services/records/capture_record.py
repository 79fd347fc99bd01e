"""Self-describing record of a capture: `record.json` in its folder holds what its database rows hold.

    {"format": 1, "capture": {"id", "eye", "taken_at", "simulated", "calibration_id", "report", "files"}, "sha256"}

`files` maps each file name to {"sha256", "bytes"}; the last `sha256` is the digest of the canonical JSON of `capture`
(sorted keys, no spaces). The record is written before the row, in the same order of writes and fsyncs as the other
files; so rows that are lost can be rebuilt from the folders (adoption.py). It is no file of the capture in the
database: `CaptureStore.read` does not return it.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from sqlalchemy.orm import Session

from device import atomic_io
from device.values import EYES
from services.errors import StoreDamaged
from services.records import row_validation, schema
from services.records.capture_report import read_report, report_as_json
from services.records.json_values import JsonObject, JsonValue
from services.records.schema import CaptureRow, FileRow

RECORD = "record.json"
FORMAT = 1


def record_of(row: CaptureRow) -> bytes:
    """Return the content of `record.json` for the row of a capture with its file rows."""
    capture: dict[str, JsonValue] = {
        "id": row.id,
        "eye": row.eye,
        "taken_at": row.taken_at,
        "simulated": row.simulated,
        "calibration_id": row.calibration_id,
        "report": json.loads(row.report),
        "files": {file.name: {"sha256": file.sha256, "bytes": file.bytes} for file in row.files},
    }
    content = {"format": FORMAT, "capture": capture, "sha256": _digest(capture)}
    return json.dumps(content, indent=1).encode()


def rewrite_record(session: Session, row: CaptureRow) -> None:
    """Replace `record.json` by that of a changed row, atomically and durably, before the transaction commits.

    If the commit fails afterwards, the record is newer than the row; the row counts, as long as it can be read. A
    capture without a folder gets no record.
    """
    folder = schema.captures_folder(session) / row.id
    if folder.is_dir():
        atomic_io.write_atomically(folder / RECORD, record_of(row))


def read_row(folder: Path) -> CaptureRow:
    """Return the row, with its file rows, that the record of a capture folder describes.

    StoreDamaged if the record is missing, unreadable, of another capture or format, or differs from its digest, or if a
    file is missing or differs from its SHA-256 or length.
    """
    with row_validation.reading_record(folder.name):
        capture = _checked(folder)
        files = _object(capture["files"])
        row = CaptureRow(
            id=row_validation.text(capture["id"]),
            eye=row_validation.one_of(capture["eye"], *EYES),
            taken_at=schema.utc_text(row_validation.timestamp(capture["taken_at"])),
            simulated=row_validation.one_of(capture["simulated"], 0, 1),
            calibration_id=row_validation.text(capture["calibration_id"]),
            report=schema.report_text(report_as_json(read_report(capture["report"]))),
            files=[_file_row(folder, name, _object(file)) for name, file in files.items()],
        )
        if row.id != folder.name or not row.files:
            raise ValueError(f"a record of {row.id} with {len(row.files)} files")
        return row


def _checked(folder: Path) -> JsonObject:
    """Return the entry `capture` of a record whose format and digest are right; ValueError otherwise."""
    try:
        content = _object(row_validation.parsed_json((folder / RECORD).read_text(encoding="utf-8")))
    except OSError as error:
        raise StoreDamaged(f"the record of {folder.name} cannot be read: {error}") from error
    if content["format"] != FORMAT:
        raise ValueError(f"format {content['format']!r:.20} instead of {FORMAT}")
    capture = _object(content["capture"])
    if content["sha256"] != _digest(capture):
        raise ValueError("the SHA-256 of the record differs")
    return capture


def _file_row(folder: Path, name: str, described: JsonObject) -> FileRow:
    """Return the row of a file whose content is as described; ValueError otherwise."""
    if Path(name).name != name:
        raise ValueError(f"{name!r:.60} is no file name")
    try:
        content = (folder / name).read_bytes()
    except OSError as error:
        raise StoreDamaged(f"{name} of {folder.name} cannot be read: {error}") from error
    digest = hashlib.sha256(content).hexdigest()
    if (described["sha256"], described["bytes"]) != (digest, len(content)):
        raise ValueError(f"the SHA-256 or length of {name} differs")
    return FileRow(name=name, sha256=digest, bytes=len(content))


def _digest(capture: Mapping[str, JsonValue]) -> str:
    canonical = json.dumps(capture, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _object(value: JsonValue) -> JsonObject:
    if not isinstance(value, dict):
        raise ValueError(f"{type(value).__name__} where an object was kept")
    return value
