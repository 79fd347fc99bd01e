"""Export of a visit: its files as a mapping for a ZIP archive or a USB drive.

De-identified: the fields name, phone and village are left out, also of the history; patient number and visit id
identify the visit, and the history names the users who changed it.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from datetime import datetime

from services.imaging.picture_files import with_note
from services.records import age_encryption
from services.records.answers import IDENTIFIERS
from services.records.capture import COLOUR, RecordOrigin
from services.records.capture_store import CaptureStore
from services.records.device_identity import read_device
from services.records.json_values import JsonObject
from services.records.visit import Visit
from services.records.visit_document import ChangeList, visit_document
from services.records.visit_repository import VisitRepository

ENCRYPTED_NAME = "visit.zip.age"
EARLIEST_ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # earliest date of a ZIP entry


def export_files(store: CaptureStore, repository: VisitRepository, visit: Visit) -> dict[str, bytes]:
    """Return the exported files of a visit by name.

    `<slot>-<number>.png` (in green light) and `.json`: picture and report of each capture, the oldest of a slot first;
    `<slot>-<number>-colour.png`: its picture in colour, if there is one; `visit.json`: the visit without identifying
    fields, with the origin of its newest picture in `device`; `history.json`: its changes (`ChangeList`), those of
    identifying fields left out; `SHA256SUMS`. StoreDamaged if any picture or report is
    damaged.
    """
    shown = visit_document(visit, repository.undo_until(visit)).model_dump(mode="json")
    return _files(store, repository, visit, shown)


def uploaded_files(store: CaptureStore, repository: VisitRepository, visit: Visit) -> dict[str, bytes]:
    """Return the uploaded files of a visit: those of the export, without the time of undo, which changes by the day."""
    return _files(store, repository, visit, visit_document(visit).model_dump(mode="json", exclude={"undo_until"}))


def _files(store: CaptureStore, repository: VisitRepository, visit: Visit, shown: JsonObject) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    device = _origin(store, visit)
    for slot, state in visit.slots.items():
        for number, taken in enumerate(state.captures, 1):
            files[f"{slot}-{number}.png"] = _picture(store, taken.capture, "picture.png")
            if COLOUR in store.get(taken.capture).files:
                files[f"{slot}-{number}-colour.png"] = _picture(store, taken.capture, COLOUR)
            files[f"{slot}-{number}.json"] = _report(store, taken.capture)
    plain = dict(shown) | {"fields": {key: value for key, value in visit.fields.items() if key not in IDENTIFIERS}}
    if device is not None:
        plain["device"] = device.as_json()
    files["visit.json"] = json.dumps(plain, indent=1, ensure_ascii=False).encode()
    history = ChangeList(changes=[one for one in repository.changes(visit.id) if one.field not in IDENTIFIERS])
    files["history.json"] = history.model_dump_json(indent=1).encode()
    sums = [f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in files.items()]
    return files | {"SHA256SUMS": "".join(sums).encode()}


def _origin(store: CaptureStore, visit: Visit) -> RecordOrigin | None:
    """Return the origin of the newest capture of a visit; without one, that of this device, None if it has no identity.

    It depends on what is stored only, so that a repeated upload is equal.
    """
    ids = sorted((taken.capture for state in visit.slots.values() for taken in state.captures), reverse=True)
    for origin in (store.get(id).report.device for id in ids):
        if origin is not None:
            return origin
    device = read_device(store.folder)
    return None if device is None else RecordOrigin(device.uuid, device.serial)


def _picture(store: CaptureStore, id: str, name: str) -> bytes:
    """Return a stored picture (PNG) of a capture.

    For a capture that was moved to the other eye, return the same pixels with the corrected eye in the note.
    """
    capture = store.get(id)
    stored = store.read(id, name)
    if not capture.report.moved:
        return stored
    return with_note(stored, f"{capture.eye} {capture.taken_at:%Y-%m-%d}")


def _report(store: CaptureStore, id: str) -> bytes:
    """Return the stored report (JSON); for a capture that was moved to the other eye, with its new eye and slot."""
    capture = store.get(id)
    stored = store.read(id, "report.json")
    if not capture.report.moved:
        return stored
    report = capture.report.as_json()
    correction = {name: report[name] for name in ("slot", "moved")}
    return json.dumps(json.loads(stored) | {"eye": capture.eye} | correction, indent=1).encode()


def folder_name(visit: Visit) -> str:
    """Return the folder name of an export: patient number and visit id."""
    return f"{visit.number}-{visit.id}"


def encrypted_copy(visit: Visit, files: Mapping[str, bytes], recipients: Sequence[str]) -> dict[str, bytes]:
    """Return the only file of an encrypted copy by name: the ZIP archive, encrypted to public keys of age."""
    archive = zip_archive(folder_name(visit), files, visit.begun_at)
    return {ENCRYPTED_NAME: age_encryption.encrypted(archive, recipients)}


def zip_archive(name: str, files: Mapping[str, bytes], begun_at: datetime) -> bytes:
    """Return a ZIP archive with the files in the folder `name`, uncompressed because PNG is compressed already.

    Each entry is dated `begun_at`, so equal files give an equal archive; dates before 1980 become 1980.
    """
    out = io.BytesIO()
    dated = max(begun_at.timetuple()[:6], EARLIEST_ZIP_DATE)
    with zipfile.ZipFile(out, "w") as archive:
        for path, content in files.items():
            archive.writestr(zipfile.ZipInfo(f"{name}/{path}", dated), content)
    return out.getvalue()
