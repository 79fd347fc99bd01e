"""Files of captures: encrypted under the key of their patient, in memory or on the disk already.

    header      `diffuscope <patient id>` and a line break; without an id for the key of the device
    content     of the file, as `PatientKeys.encrypt` returns it

A file names the patient whose key it has, so that it can be read without the database: in a journal, without a row, in
a copy. The id is a random number, and is authenticated with the content.
"""

import errno
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io
from device.user_files import files_in
from services.errors import StoreDamaged
from services.records.patient_keys import PatientKeys

_MAGIC = b"diffuscope "
_MAX_HEADER = 64
_PURPOSE = "file of a capture"  # its SHA-256 in the authenticated record binds it to its capture and name


@dataclass(frozen=True)
class WrittenFile:
    """File of a capture that is on the disk already, encrypted and durable.

    `sha256` (hexadecimal) is that of its plain content, `length_bytes` its length on the disk.
    """

    path: Path
    sha256: str
    length_bytes: int


_NO_LINKS = frozenset({errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK})  # such as a FAT file system
FileContent = bytes | WrittenFile  # of a new file: its plain content, or a file of the same file system that has it


def encrypted(keys: PatientKeys, patient_id: str, content: bytes) -> bytes:
    """Return a file of a capture as it is on the disk, under the key of its patient ("": the device).

    RecordErased if the patient's data were erased, StoreDamaged if the key is damaged.
    """
    return _MAGIC + patient_id.encode() + b"\n" + keys.encrypt(patient_id, content, _PURPOSE)


def read_file(path: Path, keys: PatientKeys) -> bytes:
    """Return the plain content of a file of a capture.

    RecordErased if its patient's data were erased, StoreDamaged if it has changed or its key is damaged, OSError if it
    cannot be read.
    """
    header, _, content = path.read_bytes().partition(b"\n")
    try:
        if not header.startswith(_MAGIC):
            raise StoreDamaged("it is not encrypted")
        return keys.decrypt(header.removeprefix(_MAGIC).decode("ascii", "replace"), content, _PURPOSE)
    except StoreDamaged as error:
        raise StoreDamaged(f"{path.name} of {path.parent.name} cannot be decrypted: {error.message}") from error


def patient_of(folder: Path) -> str | None:
    """Return the id of the patient under whose key the files in a folder are; None without an encrypted file."""
    for path in files_in(folder):
        with suppress(OSError), path.open("rb") as file:  # the other files of the folder name the same patient
            header, _, _ = file.read(_MAX_HEADER).partition(b"\n")
            if header.startswith(_MAGIC):
                return header.removeprefix(_MAGIC).decode("ascii", "replace")
    return None


def write_folder(folder: Path, contents: Mapping[str, FileContent]) -> None:
    """Write a new folder with these files (name -> content as on the disk), durable but for the folder's own name.

    A file that is on the disk already gets a second name (hard link), or is copied on a file system without hard links.
    OSError if the folder exists or the disk refuses.
    """
    atomic_io.write_folder(folder, {name: content for name, content in contents.items() if isinstance(content, bytes)})
    linked = {name: content for name, content in contents.items() if not isinstance(content, bytes)}
    for name, file in linked.items():
        _link_or_copy(file.path, folder / name)
    if linked:
        atomic_io.fsync_folder(folder)


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        atomic_io.write_file(target, source.read_bytes())
