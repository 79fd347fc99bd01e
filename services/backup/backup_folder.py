"""Folder of the backups of one device on a stick or path: encrypted objects that are written once, and keys.

    diffuscope-backup-<id>/
        README.txt              how to restore
        backup.json             id and recipients, in the clear (backup_key.py); backup-copy.json is the same
        objects/<sha256>.age    one folder of the store (a capture), as an encrypted tar archive
        index.txt               append-only: name of each backed-up content, its object, and a seal (backup_key.py)
        backups/<number>.age    one backup: everything else in the store, and the list of its objects
        patient-keys.age        keys of the patients, replaced by each backup; patient-keys-copy.age is the same

The keys are overwritten in place: an erased patient is erased in all backups.
An object is named by the SHA-256 of its encrypted content, so that a copy can be checked without a key. A line of the
index is written after its object is durable, a backup after all of its objects: a backup that was interrupted leaves
the earlier ones complete, and the next one continues.
"""

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path

from device import atomic_io
from device.user_files import files_in
from services.backup.backup_key import HEADER_FILES, BackupHeader, BackupKey, encoded_model, read_model
from services.delivery.usb_drives import drive_errors
from services.errors import BackupDamaged, UsbDriveUnavailable

PREFIX = "diffuscope-backup-"
PATIENT_KEYS = ("patient-keys.age", "patient-keys-copy.age")
_LINE = re.compile(r"([0-9a-f]{64}) ([0-9a-f]{64}) ([0-9]+) [0-9a-f]{64}")
README = """Backups of one Diffuscope device, encrypted with age (https://age-encryption.org).

Restore them on a new device, with the passphrase or with the file of the secret key:

    diffuscope store restore --from THIS-FOLDER --data /var/lib/diffuscope

Every file in objects/ is named by its SHA-256. Remove nothing: later backups need the earlier objects.
"""


class BackupFolder:
    """Folder of the backups with this key, below `place`; it is made if it is missing.

    BackupDamaged if the folder there has the header of other backups. UsbDriveFull or UsbDriveUnavailable if the place
    refuses, here and in every method.
    """

    def __init__(self, place: Path, key: BackupKey) -> None:
        self._key = key
        self.folder = place / f"{PREFIX}{key.header.id}"
        self._objects, self._backups, self._index = (self.folder / name for name in ("objects", "backups", "index.txt"))
        with drive_errors(place):
            if not place.is_dir():
                raise UsbDriveUnavailable(f"{place} is no folder that is there now")
            for folder in (self._objects, self._backups):
                atomic_io.make_folder(folder)
            self._write_header(key.header)
            self._known = self._read_index()

    def object_of(self, name: str) -> str | None:
        """Return the object (SHA-256) of a content with that name; None if it is missing or of another length."""
        entry = self._known.get(name)
        return None if entry is None else entry[0]

    def add(self, name: str, encrypted: bytes) -> str:
        """Write an object durably, read it back, list it in the index, and return its SHA-256."""
        sha256 = hashlib.sha256(encrypted).hexdigest()
        with drive_errors(self.folder):
            _write_and_read_back(self._objects / f"{sha256}.age", encrypted)
            line = self._line(name, sha256, len(encrypted))
            with open(self._index, "ab", opener=atomic_io.private_opener) as index:
                index.write(f"\n{line}\n".encode())  # a torn line before it stays a line of its own
            atomic_io.fsync_file(self._index)
        self._known[name] = (sha256, len(encrypted))
        return sha256

    def forget_damaged(self, progress: Callable[[int, int], None]) -> list[str]:
        """Read every object and return the damaged ones (SHA-256); `object_of` then treats them as missing.

        `progress` gets the number of objects read, and of all.
        """
        damaged = []
        for done, (name, (sha256, _)) in enumerate(list(self._known.items()), 1):
            try:
                read_object(self.folder, sha256)
            except BackupDamaged:
                damaged.append(sha256)
                del self._known[name]
            progress(done, len(self._known) + len(damaged))
        return damaged

    def next_number(self) -> int:
        """Return the number of the next backup."""
        return max(backup_numbers(self.folder), default=0) + 1

    def add_backup(self, number: int, encrypted: bytes) -> None:
        """Write a backup durably, after all of its objects, and read it back."""
        with drive_errors(self.folder):
            _write_and_read_back(backup_path(self.folder, number), encrypted)

    def replace_keys(self, encrypted: bytes) -> None:
        """Overwrite the keys of the patients durably, one copy after the other, and read them back."""
        with drive_errors(self.folder):
            for name in PATIENT_KEYS:
                _write_and_read_back(self.folder / name, encrypted, in_place=True)

    def _write_header(self, header: BackupHeader) -> None:
        """Write each copy of the header that is missing or unreadable; BackupDamaged if one is of other backups."""
        for name in HEADER_FILES:
            path = self.folder / name
            try:
                present = read_model(path, BackupHeader)
            except BackupDamaged:
                _write_and_read_back(self.folder / "README.txt", README.encode())
                _write_and_read_back(path, encoded_model(header))
                continue
            if present != header:
                raise BackupDamaged(f"{path} is not that of this device's backups")

    def _line(self, name: str, sha256: str, length: int) -> str:
        """Return a line of the index, sealed: a changed one could put a forged object into the next backup."""
        line = f"{name} {sha256} {length}"
        return f"{line} {self._key.seal(line.encode()).hex()}"

    def _read_index(self) -> dict[str, tuple[str, int]]:
        """Return object and length by name; without torn or forged lines, and missing or incomplete objects."""
        lines = self._index.read_text("ascii", "replace").splitlines() if self._index.exists() else []
        lengths = {path.stem: path.stat().st_size for path in files_in(self._objects, "*.age")}
        found = [(*match.groups(), line) for line in lines if (match := _LINE.fullmatch(line))]
        return {
            name: (sha256, int(length))
            for name, sha256, length, line in found
            if lengths.get(sha256) == int(length) and line == self._line(name, sha256, int(length))
        }


def backup_numbers(folder: Path) -> list[int]:
    """Return the numbers of the backups in a folder of backups, oldest first."""
    return sorted(int(path.stem) for path in files_in(folder / "backups", "*.age") if path.stem.isdecimal())


def backup_path(folder: Path, number: int) -> Path:
    """Return the file of a backup in a folder of backups."""
    return folder / "backups" / f"{number:06}.age"


def read_object(folder: Path, sha256: str) -> bytes:
    """Return an encrypted object; BackupDamaged if it is missing, unreadable or changed, while the stick is there."""
    path = folder / "objects" / f"{sha256}.age"
    content = read_backup_file(folder, path)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise BackupDamaged(f"{path.name} has changed")
    return content


def read_backup_file(folder: Path, path: Path) -> bytes:
    """Return the content of a file in a folder of backups.

    BackupDamaged if it is missing or cannot be read (a bad sector) and the header of the folder still can;
    UsbDriveUnavailable if that cannot be read either: the stick was pulled out.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        if not any(_is_on_disk(folder / name) for name in HEADER_FILES):
            raise UsbDriveUnavailable(f"{folder} refused: {error.strerror or error}") from error
        raise BackupDamaged(f"{path.name} cannot be read: {error.strerror or error}") from error


def _is_on_disk(path: Path) -> bool:
    """Return whether the disk, and not the page cache, still returns a file."""
    try:
        atomic_io.read_from_disk(path)
    except OSError:
        return False
    return True


def find_folder(place: Path) -> Path:
    """Return the folder of backups at `place`, or in it; BackupDamaged if there is none, or more than one."""
    if (place / "objects").is_dir() and (place / "backups").is_dir():
        return place
    found = [path for path in files_in(place, f"{PREFIX}*") if path.is_dir()]
    if len(found) != 1:
        listed = ", ".join(path.name for path in found) or "none"
        remedy = "Give the folder of one device's backups with --from."
        raise BackupDamaged(f"folders of backups in {place}: {listed}", remedy)
    return found[0]


def _write_and_read_back(path: Path, content: bytes, in_place: bool = False) -> None:
    """Write a file durably and compare what the disk, and not the page cache, returns; BackupDamaged if it differs.

    Under its own name at once: SHA-256 or age reveal an incomplete file, and on FAT a power cut within a rename can
    damage a complete one.
    """
    if in_place and path.exists():
        os.truncate(path, min(path.stat().st_size, len(content)))  # age adds a part of random length
        atomic_io.overwrite(path, content)
    else:
        path.unlink(missing_ok=True)  # incomplete, or changed
        atomic_io.write_file(path, content)
    atomic_io.fsync_folder(path.parent)
    if atomic_io.read_from_disk(path) != content:
        raise BackupDamaged(f"{path} cannot be read back as it was written")
