"""Content of a new file of the store, in memory or on the disk already, and folders written from such files."""

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
        atomic_io.write_file(target, source.read_bytes())
