"""USB drives: detection of mounted, writable drives, and the atomic copy of files into a new folder of one drive."""

import errno
import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io
from device.errors import StoreError
from services.errors import UsbDriveFull, UsbDriveReadOnly, UsbDriveUnavailable

ROOTS = (Path("/media"), Path("/run/media"))
MOUNTS = Path("/proc/self/mounts")
MOUNT_ESCAPES = {r"\040": " ", r"\011": "\t", r"\012": "\n", r"\134": "\\"}  # escapes of /proc/self/mounts


@dataclass(frozen=True)
class UsbDrive:
    """A mounted drive: mount point (`folder`), free space in bytes, and whether it can be written."""

    folder: Path
    free_bytes: int
    is_writable: bool

    @property
    def id(self) -> str:
        """Identifier of the mount point, which does not tell the folder."""
        return hashlib.sha256(os.fsencode(self.folder)).hexdigest()[:16]


class UsbDrives:
    """Drives mounted below `roots`; the kernel's mount table (`mounts`) is read at each call."""

    def __init__(self, roots: tuple[Path, ...] = ROOTS, mounts: Path = MOUNTS) -> None:
        self._roots, self._mounts = roots, mounts

    def present(self) -> list[UsbDrive]:
        """Return the drives that are mounted now, also those that cannot be written."""
        found = []
        for folder in self._mounted():
            try:
                found.append(UsbDrive(folder, atomic_io.free_bytes(folder), os.access(folder, os.W_OK)))
            except OSError:  # removed since the mount table was read
                continue
        return found

    def mounted_folder(self, id: str) -> Path:
        """Return the mount point of the drive with that id.

        UsbDriveUnavailable if it is not mounted now, UsbDriveReadOnly if it cannot be written.
        """
        for drive in self.present():
            if drive.id == id:
                if not drive.is_writable:
                    raise UsbDriveReadOnly(f"{drive.folder.name} can only be read")
                return drive.folder
        raise UsbDriveUnavailable(f"{id[:80]!r} is no USB stick that is there now")

    def _mounted(self) -> list[Path]:
        lines = self._mounts.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
        folders = [Path(_unescaped(line.split(" ")[1])) for line in lines]
        return [folder for folder in folders if any(root in folder.parents for root in self._roots)]


def _unescaped(word: str) -> str:
    for code, letter in MOUNT_ESCAPES.items():
        word = word.replace(code, letter)
    return word


def copy_to_drive(drive: Path, name: str, files: Mapping[str, bytes]) -> Path:
    """Copy files into a new folder of a drive; return the folder once it is durable and was read back.

    `drive`: mount point; `name`: name of the new folder, with a number appended if that folder exists. The folder gets
    this name after all files are written; after an error in writing them the partial copy is deleted, if the drive is
    still there. Errors: UsbDriveFull, UsbDriveUnavailable.
    """
    with drive_errors(drive):
        target = drive / name
        number = 1
        while target.exists():
            number += 1
            target = drive / f"{name}-{number}"
        temporary = drive / f".{target.name}.part"
        shutil.rmtree(temporary, ignore_errors=True)  # left by an interrupted copy
        try:
            atomic_io.write_folder(temporary, files, private=False)
            atomic_io.replace_durably(temporary, target)
        except OSError:
            shutil.rmtree(temporary, ignore_errors=True)  # no effect on a removed drive
            raise
        atomic_io.fsync_folder(target)  # on FAT, fsync of a folder writes its own entry, fsync of its parent does not
        changed = [name for name, content in files.items() if atomic_io.read_from_disk(target / name) != content]
    if changed:
        raise UsbDriveUnavailable(
            f"{drive.name} does not return what was written: {changed[0]}", "Use another USB stick."
        )
    return target


@contextmanager
def drive_errors(drive: Path) -> Iterator[None]:
    """Convert OSError to UsbDriveFull, UsbDriveReadOnly or UsbDriveUnavailable; a context manager."""
    try:
        yield
    except OSError as error:
        raise _kind_of(error)(f"{drive.name} refused: {error.strerror or error}") from error


def _kind_of(error: OSError) -> type[StoreError]:
    if atomic_io.is_full(error):
        return UsbDriveFull
    return UsbDriveReadOnly if error.errno == errno.EROFS else UsbDriveUnavailable
