"""Refusal of a data folder without captures, and of one that a version before the first release wrote.

Its files are neither read nor changed.
"""

import sqlite3
from contextlib import closing, suppress
from pathlib import Path

from device.errors import StoreError
from services.errors import RecordNotFound

EARLIER_NAMES = ("shelf.sqlite", "torn", "light.copy")  # database, quarantine, copy of the dose ledger
FIRST_REVISION = "s0001"  # of the tables; revisions sort by time, and those before the first release began with "r"


def refuse_earlier_store(database: Path, what: str | None = None) -> None:
    """Raise StoreError if a version before the first release wrote the folder of `database`; nothing is changed.

    `what`: words for the folder in the message; None: its path.
    """
    described = what or str(database.parent)
    if any(database.with_name(name).exists() for name in EARLIER_NAMES):
        raise _earlier(described)
    if database.exists():
        # immutable: SQLite neither applies nor removes the write-ahead log. What only the log holds, `migrate` refuses.
        uri = f"{database.absolute().as_uri()}?mode=ro&immutable=1"
        # UnicodeDecodeError: of SQLite's message about a damaged definition. What is damaged, recovery.py handles.
        with suppress(sqlite3.DatabaseError, UnicodeDecodeError), closing(sqlite3.connect(uri, uri=True)) as tables:
            for (revision,) in tables.execute("SELECT version_num FROM alembic_version").fetchall():
                refuse_earlier_tables(revision, described)


def require_store(database: Path) -> None:
    """Raise RecordNotFound if the folder of `database` holds no captures; as `refuse_earlier_store` otherwise."""
    if not database.with_name("captures").is_dir():
        raise RecordNotFound(f"{database.parent} holds no captures", "Give the folder of the captures with --data.")
    refuse_earlier_store(database)


def refuse_earlier_tables(revision: str, described: str) -> None:
    """Raise StoreError if `revision` of the tables of a store is older than the first release."""
    if revision < FIRST_REVISION:
        raise _earlier(described)


def _earlier(described: str) -> StoreError:
    return StoreError(
        f"{described} was written by a version before the first release, which cannot be read here",
        "Nothing was changed. Give another folder with --data, or use the version that wrote this one.",
    )
