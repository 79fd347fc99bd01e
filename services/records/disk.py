"""Writing so that a power cut cannot take it back: each file, then its folder, is on the disk before the next step."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

RESERVE_BYTES = 200_000_000  # the computer's own logs and updates must fit beside us, or it will not start again
# EFBIG is a limit on one file's length: to the operator the same as a full disk.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def free_bytes(folder: Path) -> int:
    """How much a new file in `folder` could hold."""
    return shutil.disk_usage(folder).free


def is_full(error: OSError) -> bool:
    """Whether an error of the operating system says that there is no room."""
    return error.errno in _FULL


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, whose names outlive a power cut."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        settle(folder.parent)


def write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make a new folder holding `files`, all of it on the disk when this returns (the folder's own name is not yet)."""
    folder.mkdir()
    for name, content in files.items():
        write_file(folder / name, content)
    settle(folder)


def write_file(path: Path, content: bytes) -> None:
    """Write a new file, on the disk when this returns (its name is not yet)."""
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        descriptor = file.fileno()
        os.fsync(descriptor)


def settle(folder: Path) -> None:
    """Wait until the names in a folder are on the disk: without this a rename can be undone by a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def move_aside(stray: Path, refuge: Path) -> str:
    """Move a folder into `refuge` under a name not taken there, and return that name; the caller settles both ends."""
    plain = stray.name.removeprefix(".").removesuffix(".part")
    name, number = plain, 1
    while (refuge / name).exists():
        number += 1
        name = f"{plain}-{number}"
    stray.rename(refuge / name)
    return name


def size_bytes(place: Path) -> int:
    """How much room a file, or all files below a folder, would give back."""
    return sum(path.lstat().st_size for path in (place, *place.rglob("*")) if not path.is_dir())


def remove(place: Path) -> None:
    """Remove a file, or a folder with all that is in it."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink()


@contextmanager
def alone(lock: Path) -> Iterator[None]:
    """Wait until no other thread or process is in here with the same lock file; a killed one gives its place up.

    The file is opened anew each time because the lock belongs to the opening: one shared by threads would let all in.
    """
    with lock.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
