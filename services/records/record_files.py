"""Files of the records in a store: `patients/<id>.json`, `visits/<id>.json` and `captures/<id>/record.json`.

`record-key-id` names the key with which all of them are authenticated, if there is one.
"""

import hashlib
import hmac
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from device import atomic_io
from device.user_files import files_in
from services.errors import StoreDamaged
from services.records import row_validation
from services.records.record_document import Kind, RecordDocument, parse_document

CAPTURE_RECORD, KEY_ID = "record.json", "record-key-id"
_FOLDERS: dict[Kind, str] = {"patient": "patients", "visit": "visits"}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class RecordFiles:
    """Files of the records of the store in `folder`, authenticated by its key; the caller serialises writers."""

    def __init__(self, folder: Path, key: bytes | None = None) -> None:
        self._folder, self._key = folder, key

    def exist(self) -> bool:
        """Return whether the folders of the files are here, so that the rows of visits can be rebuilt from them."""
        return all((self._folder / name).is_dir() for name in _FOLDERS.values())

    def make_folders(self) -> None:
        """Create the folders of the files durably; OSError if the disk refuses."""
        for name in _FOLDERS.values():
            atomic_io.make_folder(self._folder / name)

    def path(self, kind: Kind, id: str) -> Path:
        """Return the path of the file of a record; ValueError if the id cannot name a file."""
        if not _NAME.fullmatch(id):
            raise ValueError(f"{id!r:.60} cannot name a file")
        if kind == "capture":
            return self._folder / "captures" / id / CAPTURE_RECORD
        return self._folder / _FOLDERS[kind] / f"{id}.json"

    def read(self, kind: Kind, id: str) -> RecordDocument | None:
        """Return the document in the file of a record; None without a file, StoreDamaged if it cannot be read."""
        with row_validation.reading_record(id):
            path = self.path(kind, id)
            try:
                content = path.read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None
            except OSError as error:
                raise StoreDamaged(f"the record of {id} cannot be read: {error}") from error
            document = parse_document(content, self._key)
            if (document.kind, document.id) != (kind, id):
                raise ValueError(f"a record of the {document.kind} {document.id!r:.60}")
            return document

    def ids(self, kind: Kind) -> Iterator[str]:
        """Yield the ids of the patients or visits that have a file, or of the captures that have a folder, sorted."""
        if kind == "capture":
            yield from [path.name for path in files_in(self._folder / "captures") if path.is_dir()]
        elif (folder := self._folder / _FOLDERS[kind]).is_dir():
            yield from [path.stem for path in files_in(folder, "*.json")]

    def write(self, documents: Iterable[RecordDocument]) -> None:
        """Write or replace the files of these records, each atomically and durably, in the given order.

        A capture without a folder gets no file. OSError if the disk refuses.
        """
        for document in documents:
            path = self.path(document.kind, document.id)
            if path.parent.is_dir():
                atomic_io.write_atomically(path, document.encoded(self._key))

    def write_all(self, documents: Iterable[RecordDocument]) -> None:
        """Write or replace the files of many records, durable on return by one sync instead of two for each file.

        A power cut before the end may leave incomplete files, which differ from their digest and are written again.
        OSError if the disk refuses.
        """
        written = False
        for document in documents:
            path = self.path(document.kind, document.id)
            if path.parent.is_dir():
                atomic_io.write_atomically_unsynced(path, document.encoded(self._key))
                written = True
        if written:
            os.sync()

    def remove(self, kind: Kind, id: str) -> None:
        """Remove the file of a patient or visit whose rows were not committed; without a file do nothing."""
        path = self.path(kind, id)
        if kind != "capture" and path.exists():
            path.unlink()
            atomic_io.fsync_folder(path.parent)


def new_key(folder: Path, key: bytes | None) -> bytes | None:
    """Return the key if no note says that the files of a store were written with it; None without a key."""
    path = folder / KEY_ID
    return None if key is None or (path.exists() and path.read_bytes() == _key_id(key)) else key


def note_key(folder: Path, key: bytes) -> None:
    """Note durably that the files of a store are written with this key; OSError if the disk refuses."""
    atomic_io.write_atomically(folder / KEY_ID, _key_id(key))


def _key_id(key: bytes) -> bytes:
    return hmac.new(key, b"id", hashlib.sha256).hexdigest().encode()
