"""Conversion of errors of the disk and of SQLite to the errors of the store."""

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import DBAPIError

from device import atomic_io
from device.errors import StoreError, StoreFull, StoreReadOnly
from services.errors import StoreDamaged, StoreLocked

_READ_ONLY = frozenset({errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM})
# By the beginning of SQLite's name of the error; the first that fits counts.
_KINDS: dict[str, type[StoreError]] = {
    "SQLITE_FULL": StoreFull,
    "SQLITE_IOERR_SHMSIZE": StoreFull,  # no space for the index of the write-ahead log
    "SQLITE_CORRUPT": StoreDamaged,
    "SQLITE_NOTADB": StoreDamaged,
    "SQLITE_BUSY": StoreLocked,
    "SQLITE_LOCKED": StoreLocked,
    "SQLITE_READONLY": StoreReadOnly,
    "SQLITE_IOERR": StoreReadOnly,
    "SQLITE_CANTOPEN": StoreReadOnly,
    "SQLITE_PERM": StoreReadOnly,
}


def is_disk_full(error: OSError | DBAPIError) -> bool:
    """Return whether the error means that the disk, the quota or the database is full."""
    return atomic_io.is_full(error) if isinstance(error, OSError) else sqlite_name(error.orig) == "SQLITE_FULL"


def is_locked(error: OSError | DBAPIError) -> bool:
    """Return whether the error means that another program holds the lock of the database: nothing was committed."""
    return isinstance(error, DBAPIError) and _sqlite_kind(error.orig) is StoreLocked


def sqlite_name(error: BaseException | None) -> str:
    """Return SQLite's name of an error such as "SQLITE_FULL"; "" for an error of the driver, which has none."""
    return getattr(error, "sqlite_errorname", "")


@contextmanager
def storage_errors() -> Iterator[None]:
    """Convert OSError and SQLite errors to the errors of the store; a context manager.

    StoreFull: disk, quota or database full. StoreReadOnly: disk, folder or database that takes no changes. StoreLocked:
    database locked by another program. StoreDamaged: corrupt database. Otherwise StoreError.
    """
    try:
        yield
    except OSError as error:
        raise _kind_of(error)(f"the disk refused: {error}") from error
    except DBAPIError as error:
        raise _sqlite_kind(error.orig)(f"the database refused: {error.orig}") from error
    except sqlite3.Error as error:
        raise _sqlite_kind(error)(f"the database refused: {error}") from error


def _kind_of(error: OSError) -> type[StoreError]:
    if atomic_io.is_full(error):
        return StoreFull
    return StoreReadOnly if error.errno in _READ_ONLY else StoreError


def _sqlite_kind(error: BaseException | None) -> type[StoreError]:
    name = sqlite_name(error)
    return next((kind for start, kind in _KINDS.items() if name.startswith(start)), StoreError)
