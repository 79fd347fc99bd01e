"""Conversion of errors of the disk and of SQLite to the errors of the store."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import DBAPIError

from device import atomic_io
from device.errors import StoreError, StoreFull
from services.errors import StoreDamaged


def is_disk_full(error: OSError | DBAPIError) -> bool:
    """Return whether the error means that the disk, the quota or the database is full."""
    return atomic_io.is_full(error) if isinstance(error, OSError) else sqlite_name(error.orig) == "SQLITE_FULL"


def sqlite_name(error: BaseException | None) -> str:
    """Return SQLite's name of an error such as "SQLITE_FULL"; "" for an error of the driver, which has none."""
    return getattr(error, "sqlite_errorname", "")


@contextmanager
def storage_errors() -> Iterator[None]:
    """Convert OSError and SQLite errors to StoreFull, StoreDamaged or else StoreError; a context manager.

    StoreFull: disk, quota or database full. StoreDamaged: corrupt database.
    """
    try:
        yield
    except OSError as error:
        kind = StoreFull if atomic_io.is_full(error) else StoreError
        raise kind(f"the disk refused: {error}") from error
    except DBAPIError as error:
        raise _KINDS.get(sqlite_name(error.orig), StoreError)(f"the database refused: {error.orig}") from error
    except sqlite3.Error as error:
        raise _KINDS.get(sqlite_name(error), StoreError)(f"the database refused: {error}") from error


_KINDS: dict[str, type[StoreError]] = {
    "SQLITE_FULL": StoreFull,
    "SQLITE_IOERR_SHMSIZE": StoreFull,  # no space for the index of the write-ahead log
    "SQLITE_CORRUPT": StoreDamaged,
    "SQLITE_NOTADB": StoreDamaged,
}
