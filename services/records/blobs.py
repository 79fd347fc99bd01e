"""Reading and writing of whole files of the store: frames, pictures, reports and records."""

import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from device import atomic_io


@dataclass(frozen=True)
class WrittenFile:
    """File of a capture that is on the disk already, durably: its path, SHA-256 (hexadecimal) and length in bytes."""

    path: Path
    sha256: str
    length_bytes: int


_NO_LINKS = frozenset({errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK})  # such as a FAT file system
FileContent = bytes | WrittenFile  # of a new file: its content, or a file of the same file system that has it


def read_blob(path: Path) -> bytes:
    """Return the content of a file; OSError if it cannot be read."""
    return path.read_bytes()


def write_blob(path: Path, content: bytes) -> None:
    """Write or replace a file atomically and durably; OSError if the disk refuses."""
    atomic_io.write_atomically(path, content)


def write_blob_unsynced(path: Path, content: bytes) -> None:
    """Write or replace a file atomically for other processes, but not durably: a power cut may leave it incomplete."""
    atomic_io.write_atomically_unsynced(path, content)


def write_new_blob(path: Path, content: bytes) -> None:
    """Write a new file; its name is durable after `fsync_folder`. OSError if it exists or the disk refuses."""
    atomic_io.write_file(path, content)


def write_folder(folder: Path, contents: Mapping[str, FileContent]) -> None:
    """Write a new folder with these files (name -> content), durable on return but for the folder's own name.

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
        write_new_blob(target, read_blob(source))
