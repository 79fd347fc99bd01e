"""Later versions of the pictures of captures, beside those that were taken, which stay as they are.

    captures/<id>/picture-1.png    the picture of the first version; colour-1.png beside it, if it is in colour
    captures/<id>/report-1.json    its report: frames, calibration, software, settings, figures

The files are durable before the rows that name them. After a power cut in between they are files without a row, which
the next adoption replaces.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from device import atomic_io
from services.errors import RecordNotFound, VersionRefused
from services.records import blobs, row_validation, schema
from services.records.capture import CaptureReport, CaptureVersion
from services.records.capture_rows import NAME
from services.records.patient_keys import PatientKeys
from services.records.patient_rows import patient_of_visit
from services.records.record_signing import recorded
from services.records.schema import CaptureRow, FileRow
from services.records.storage_errors import storage_errors

RAW_FRAME = re.compile(r"raw(-([0-9]+|[a-z]+))?[.]tiff")
DARK_FRAME = "dark.tiff"


@dataclass(frozen=True)
class NewVersion:
    """A later picture of the capture with this id; PNG, and JSON of its report.

    `result`: name of the result, which makes the adoption idempotent. `frames`: SHA-256 of the raw frames and the dark
    frame that it was made from, by name of the file in the store. `device`: UUID of the device that took them, empty if
    unknown.
    """

    capture: str
    result: str
    frames: Mapping[str, str]
    device: str
    method: str
    software: str
    picture: bytes
    report: bytes
    colour: bytes | None = None


class CaptureVersions:
    """Versions of the captures in the folder `captures`; a lock file `lock` serialises writers."""

    def __init__(self, captures: Path, lock: Path, engine: Engine, keys: PatientKeys) -> None:
        self._captures, self._lock, self._engine, self._keys = captures, lock, engine, keys

    def adopt(self, new: NewVersion, at: datetime) -> CaptureVersion:
        """Store a later picture as the next version of its capture; return it, or the version with this result.

        Errors: RecordNotFound (no such capture), VersionRefused (of other frames or another device), StoreDamaged (its
        row cannot be read), StoreFull, StoreReadOnly, StoreError (the disk refuses). Nothing is changed then.
        """
        schema.refuse_if_read_only(self._engine)
        with storage_errors(), atomic_io.file_lock(self._lock), recorded(self._engine) as session:
            row = _row(session, new.capture)
            with row_validation.reading_record(row.id):
                report = CaptureReport.parse(row.report)
            _refuse_foreign(new, row, None if report.device is None else report.device.uuid)
            known = next((earlier for earlier in report.versions if earlier.result == new.result), None)
            if known is not None:
                return known
            number = max((earlier.number for earlier in report.versions), default=0) + 1
            version = CaptureVersion(number, new.result, at.isoformat(), new.method, new.software)
            self._write(row, version, new)
            row.report = schema.report_text(report.with_version(version))
            return version

    def _write(self, row: CaptureRow, version: CaptureVersion, new: NewVersion) -> None:
        """Write the files of a version and add their rows; files that a power cut left without rows are replaced."""
        files = {version.picture: new.picture, version.report: new.report}
        files |= {} if new.colour is None else {version.colour: new.colour}
        place = self._captures / row.id
        patient_id = patient_of_visit(self._engine, row.visit)
        stored = {name: blobs.encrypted(self._keys, patient_id, content) for name, content in files.items()}
        try:
            for name, content in stored.items():
                atomic_io.write_atomically(place / name, content)
        except OSError:
            for name in files:
                (place / name).unlink(missing_ok=True)
            raise
        row.files += [
            FileRow(name=name, sha256=hashlib.sha256(content).hexdigest(), bytes=len(stored[name]))
            for name, content in files.items()
        ]


def _row(session: Session, id: str) -> CaptureRow:
    """Return the row of a capture; RecordNotFound if unknown or no valid id."""
    row = session.get(CaptureRow, id) if NAME.fullmatch(id) else None
    if row is None:
        raise unknown_capture(id)
    return row


def unknown_capture(id: str) -> RecordNotFound:
    """Return the error of a later picture whose capture the store does not hold."""
    return RecordNotFound(
        f"this store has no capture named {id!r}",
        "Give the store that holds it. The pictures of an erased patient cannot be adopted.",
    )


def _refuse_foreign(new: NewVersion, row: CaptureRow, device: str | None) -> None:
    """Raise VersionRefused for a picture of other frames, or of the frames of another device."""
    if new.device and device is not None and new.device != device:
        raise VersionRefused(
            f"{row.id} was taken by the device {device}, and the new picture by {new.device}",
            "Adopt it in the store of that device.",
        )
    kept = {file.name: file.sha256 for file in row.files if RAW_FRAME.fullmatch(file.name) or file.name == DARK_FRAME}
    if differing := sorted(name for name in {*kept, *new.frames} if kept.get(name) != new.frames.get(name)):
        raise VersionRefused(f"{row.id} holds other frames than the new picture was made from: {', '.join(differing)}")
