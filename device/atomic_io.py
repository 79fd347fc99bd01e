"""Atomic and durable file writes (write, fsync of the file, rename, fsync of the folder), and file locks (flock).

`write_atomically` replaces one file; the steps of a longer write are separate functions, and `replace_durably` is the
last one. Each step is on the disk before the next begins, so a power cut leaves the old or the new state.
Files and folders are private (PRIVATE_FILE, PRIVATE_FOLDER) unless the caller gives another mode; None is that of the
umask, for what a command writes to a path that its user names. Those of root get the owner of the folder that they are
in: a command as root must leave no file in a data folder that the server, another user, cannot read.
"""

import errno
import fcntl
import math
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

PRIVATE_FILE, PRIVATE_FOLDER = 0o600, 0o700  # of data about people and of keys, whatever the umask
RESERVE_BYTES = 200_000_000  # left free for logs and updates of the operating system, which else may not boot
# EFBIG is a limit on the length of one file: for the operator the same as a full disk.
_MEMORY = Path("/dev/shm")
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system of `folder` for unprivileged users, bytes; RESERVE_BYTES included."""
    return shutil.disk_usage(folder).free


def memory_folder() -> Path | None:
    """Return the folder of files in memory, for plain content that must not be on a disk; None if there is none."""
    return _MEMORY if _MEMORY.is_dir() else None


def free_files(folder: Path) -> float:
    """Return how many files and folders the file system of `folder` still takes from unprivileged users.

    Infinity on a file system without a fixed number of them, such as FAT or Btrfs.
    """
    state = os.statvfs(folder)
    return state.f_favail if state.f_files else math.inf


def has_room(need_bytes: int, free_bytes: int, reserve_bytes: int = RESERVE_BYTES) -> bool:
    """Return whether `need_bytes` fit into the free space beside the reserve; true if they fit exactly."""
    return free_bytes >= need_bytes + reserve_bytes


def is_full(error: OSError) -> bool:
    """Return true if an error of the operating system means a full disk, quota or file size limit."""
    return error.errno in _FULL


def make_folder(folder: Path, mode: int | None = PRIVATE_FOLDER) -> None:
    """Make a folder and its missing parents durably: the parent of each new folder is synced; no-op if it exists.

    `mode`: permission bits of each new folder, independent of the umask; None: those of an ordinary new folder.
    """
    if not folder.is_dir():
        make_folder(folder.parent, mode)
        _make_one(folder, mode, exist_ok=True)
        fsync_folder(folder.parent)


def make_private(folder: Path) -> None:
    """Make a folder durably, or take the rights of other users from an existing one.

    PermissionError if it belongs to another user, who alone may do that.
    """
    make_folder(folder)
    if (mode := stat.S_IMODE(folder.stat().st_mode)) & 0o077:
        folder.chmod(mode & 0o700)


def _make_one(folder: Path, mode: int | None, exist_ok: bool = False) -> None:
    folder.mkdir(0o777 if mode is None else mode, exist_ok=exist_ok)
    if mode is not None:
        folder.chmod(mode)
    if (owner := _other_owner(folder.parent)) is not None:
        os.lchown(folder, owner, -1)  # of a link that has replaced the folder meanwhile, the link


def _other_owner(folder: Path) -> int | None:
    """Return the id of the user to whom a new file or folder of root in `folder` belongs; None if nothing changes."""
    owner = folder.stat().st_uid
    return owner if os.geteuid() == 0 and owner != 0 else None


def write_folder(folder: Path, files: Mapping[str, bytes], private: bool = True) -> None:
    """Make a new folder with `files`, content and file names durable on return; not `private`: with the umask's modes.

    The folder's own name is durable only after `fsync_folder` of its parent. FileExistsError if the folder exists.
    """
    _make_one(folder, PRIVATE_FOLDER if private else None)
    for name, content in files.items():
        write_file(folder / name, content, PRIVATE_FILE if private else None)
    fsync_folder(folder)


def private_opener(path: str | os.PathLike[str], flags: int) -> int:
    """Return a descriptor of a file, private if it is new; the argument `opener` of `open`."""
    owner = _other_owner(Path(path).parent)
    if owner is None or not flags & os.O_CREAT:
        return os.open(path, flags | os.O_CLOEXEC, PRIVATE_FILE)
    try:
        descriptor = os.open(path, flags | os.O_EXCL | os.O_CLOEXEC, PRIVATE_FILE)
    except FileExistsError:  # keeps its owner: a link that the other user made may lead to a file of root
        return os.open(path, flags | os.O_CLOEXEC, PRIVATE_FILE)
    os.fchown(descriptor, owner, -1)
    return descriptor


def write_file(path: Path, content: bytes, mode: int | None = PRIVATE_FILE) -> None:
    """Write a new file and fsync it; its name is durable only after `fsync_folder`. FileExistsError if it exists.

    `mode`: permission bits of the file, independent of the umask; None: those of an ordinary new file.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666 if mode is None else mode)
    with open(descriptor, "wb") as file:
        if (owner := _other_owner(path.parent)) is not None:
            os.fchown(descriptor, owner, -1)
        if mode is not None:
            os.fchmod(descriptor, mode)
        file.write(content)
        file.flush()
        os.fsync(descriptor)


def write_atomically(path: Path, content: bytes, mode: int | None = PRIVATE_FILE) -> None:
    """Write or replace a file durably: after a power cut it has the old or the new content. `mode` as in `write_file`.

    After an OSError `path` is unchanged, unless the last step, the fsync of the folder, failed.
    """
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)  # left by a power cut
    try:
        write_file(part, content, mode)
        part.rename(path)
    except OSError:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    fsync_folder(path.parent)


def overwrite(path: Path, content: bytes, at_byte: int = 0, whole: bool = False) -> None:
    """Overwrite a part of a file, or the `whole`, in place and durably: no older file with what was there stays."""
    with open(path, "r+b") as file:
        file.seek(at_byte)
        file.write(content)
        if whole:
            file.truncate()
        file.flush()
        os.fsync(file.fileno())


def write_atomically_unsynced(path: Path, content: bytes) -> None:
    """Write or replace a private file atomically for other processes; a power cut may leave it incomplete."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)  # left by a killed process
    with open(part, "wb", opener=private_opener) as file:
        file.write(content)
    part.rename(path)


def replace_durably(source: Path, target: Path) -> None:
    """Rename a file or folder to `target` durably; it replaces a file, or an empty folder, of that name.

    The content of `source` is on the disk already. The folder of `target` is synced before the folder of `source`.
    """
    source.rename(target)
    fsync_folder(target.parent)
    if source.parent != target.parent:
        fsync_folder(source.parent)


def read_from_disk(path: Path) -> bytes:
    """Return the content of a synced file as the disk has it, past the page cache."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        return file.read()


def fsync_file(path: Path) -> None:
    """Fsync the content of a file, of which another program or function wrote all bytes."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_folder(folder: Path) -> None:
    """Fsync a folder, so that a power cut cannot undo a rename or new name in it."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def quarantine(stray: Path, quarantine_folder: Path) -> str:
    """Move a file or folder into `quarantine_folder` under a free name, and return that name.

    The name is the old one without a leading "." and without ".part", with "-2", "-3", ... if it is taken. The caller
    syncs both parent folders.
    """
    plain = stray.name.removeprefix(".").removesuffix(".part")
    name = plain
    number = 1
    while (quarantine_folder / name).exists():
        number += 1
        name = f"{plain}-{number}"
    stray.rename(quarantine_folder / name)
    return name


def size_bytes(place: Path) -> int:
    """Return the size of a file, or the total size of all files below a folder, bytes; symbolic links not followed."""
    return sum(path.lstat().st_size for path in (place, *place.rglob("*")) if not path.is_dir())


def number_of_files(place: Path) -> int:
    """Return the number of files and folders of a file, or of a folder with all that is below it."""
    return sum(1 for _ in (place, *place.rglob("*")))


def remove(place: Path) -> None:
    """Remove a file, or a folder with its content."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink()


@contextmanager
def file_lock(lock: Path, wait: bool = True, private: bool = True) -> Iterator[None]:
    """Hold an exclusive lock (flock) on the file `lock`, a mutex across threads and processes.

    Without `wait`: BlockingIOError if the lock is held elsewhere. OSError if the file cannot be opened. The kernel
    releases the lock of a killed process. The file is opened for each lock because flock belongs to the open file
    description: threads that share one would not exclude each other.
    """
    with open(lock, "ab", opener=private_opener if private else None) as file:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
