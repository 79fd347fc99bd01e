"""Reading and writing of whole files of the store: the one place through which the content of its files passes.

A later encryption of the files needs a change here only.
"""

from collections.abc import Mapping
from pathlib import Path

from device import atomic_io


def read_blob(path: Path) -> bytes:
    """Return the content of a file; OSError if it cannot be read."""
    return path.read_bytes()


def write_blob(path: Path, content: bytes) -> None:
    """Write or replace a file atomically and durably; OSError if the disk refuses."""
    atomic_io.write_atomically(path, content)


def write_blob_unsynced(path: Path, content: bytes) -> None:
    """Write or replace a file atomically for other processes, but not durably: a power cut may leave it incomplete."""
    atomic_io.write_atomically_unsynced(path, content)


def write_folder(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write a new folder with these files (name -> content), durable on return but for the folder's own name.

    OSError if the folder exists or the disk refuses.
    """
    atomic_io.write_folder(folder, contents)
