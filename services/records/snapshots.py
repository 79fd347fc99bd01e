"""Snapshots of the database before each migration, and their restoration by a technician.

    FOLDER/<schema>-<date>.db     one for each of the last three schema versions, written atomically
    FOLDER/replaced-<n>/          database files that a restored snapshot replaced

After a rollback of an update the older release reads the newer tables (README, "Add a column"), so snapshots are needed
only after a harmful migration. They hold the database only: migrations do not change the files of captures.
"""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from device import atomic_io
from device.clock import Clock
from device.errors import StoreError, StoreFull
from device.light_safety.dose_ledger import DoseLedgerState
from device.user_files import files_in
from device.values import EYES
from services.errors import RecordNotFound, StoreDamaged
from services.records.dose_ledger_log import LOG, DoseLedgerLog, raise_doses
from services.records.earlier_stores import refuse_earlier_store

KEPT_VERSIONS = 3
LOG_SUFFIXES = ("journal", "wal", "shm")  # SQLite would apply a leftover log to the restored database
MARGIN_BYTES = 10_000_000  # margin for other writers


class Snapshots:
    """Snapshots of one database file, in the folder `snapshots` beside it."""

    def __init__(self, database: Path, clock: Clock, free_bytes: Callable[[Path], int] = atomic_io.free_bytes) -> None:
        self.database = database
        self.folder = database.parent / "snapshots"
        self._clock, self._free_bytes = clock, free_bytes

    def names(self) -> list[str]:
        """Return the names of the snapshots, oldest schema first."""
        return [path.name for path in files_in(self.folder, "*.db")]

    def create(self, schema: str) -> None:
        """Copy the database, whose schema version is `schema`; the copy is durable when the call returns.

        Atomic write: after a power cut the copy is complete or absent, and the next start repeats it before the
        migration. Snapshots older than the last KEPT_VERSIONS schema versions are deleted. StoreFull if the space does
        not suffice for the copy and the migration; OSError or sqlite3.Error if the copy fails.
        """
        atomic_io.make_folder(self.folder)
        name = f"{schema}-{self._clock.wall():%Y%m%dT%H%M%S}.db"
        part = self.folder / ".part"
        part.unlink(missing_ok=True)
        with _connected(self.database) as tables:
            size_bytes = _number(tables, "page_count") * _number(tables, "page_size")
            self._refuse_without_room(size_bytes)
            try:
                atomic_io.write_file(part, b"")  # private; SQLite writes into an empty file
                tables.execute("VACUUM INTO ?", (str(part),))
            except sqlite3.Error:
                part.unlink(missing_ok=True)
                raise
        atomic_io.fsync_file(part)
        atomic_io.replace_durably(part, self.folder / name)
        self._delete_old(name)

    def restore(self, name: str) -> Path:
        """Replace the database by a snapshot, but for its doses; return the folder that holds the replaced files.

        Errors: RecordNotFound (unknown name), StoreDamaged (the snapshot fails the integrity check), StoreError
        (another process uses the database, or the snapshot is of a version before the first release), OSError. After a
        power cut during the replacement the store may refuse to open, or rebuild its tables from the files of the
        records; a second restoration repairs it.
        """
        if name not in self.names():
            raise RecordNotFound(f"there is no snapshot {name!r}", "`diffuscope snapshots list` names them.")
        _refuse_damaged(self.folder / name)
        refuse_earlier_store(self.folder / name, f"the snapshot {name}")
        refuse_in_use(self.database)
        new = self.database.with_name(".store.part")
        new.unlink(missing_ok=True)  # left by an interrupted restoration
        atomic_io.write_file(new, (self.folder / name).read_bytes())
        carry_dose(self.database, new)
        atomic_io.fsync_file(new)
        atomic_io.fsync_folder(self.database.parent)
        replaced = move_to_numbered_folder(self.database, self.folder, "replaced-")
        atomic_io.replace_durably(new, self.database)
        return replaced

    def missing_from(self, name: str, captures: Path) -> list[str]:
        """Return the sorted names of the folders in `captures` without a row in the snapshot `name`: stored later."""
        with _connected(self.folder / name) as tables:
            known = {id for (id,) in tables.execute("SELECT id FROM captures")}
        return [path.name for path in files_in(captures, "*") if path.name not in known]

    def _refuse_without_room(self, size_bytes: int) -> None:
        """Raise StoreFull if less space than 2 `size_bytes` + MARGIN_BYTES is free, for the copy and the migration.

        The reserve that captures leave free may be used, because it is meant for updates.
        """
        need = 2 * size_bytes + MARGIN_BYTES
        free = self._free_bytes(self.database.parent)
        if not atomic_io.has_room(need, free, reserve_bytes=0):
            raise StoreFull(
                f"{free} bytes are free; {need} are needed to copy the tables before they are changed",
                "No space left, so nothing was changed. Remove files from the disk, or go back to the version before.",
            )

    def _delete_old(self, newest: str) -> None:
        """Delete the snapshots except `newest` and the last one of each of the last KEPT_VERSIONS schema versions."""
        newest_of_schema = {name.split("-")[0]: name for name in (*self.names(), newest)}
        kept = {*sorted(newest_of_schema.values())[-KEPT_VERSIONS:], newest}
        for name in self.names():
            if name not in kept:
                (self.folder / name).unlink()


def move_to_numbered_folder(database: Path, parent: Path, prefix: str) -> Path:
    """Move a database with its logs to the first free of the folders `<parent>/<prefix><n>`; return it.

    The database is moved first: what remains after a kill or a power cut is no database with another's log. OSError if
    the disk refuses.
    """
    number = 1
    while (folder := parent / f"{prefix}{number}").exists():
        number += 1
    atomic_io.make_folder(folder)
    for suffix in ("", *(f"-{log}" for log in LOG_SUFFIXES)):
        present = database.with_name(database.name + suffix)
        if present.exists():
            atomic_io.replace_durably(present, folder / present.name)
    return folder


@contextmanager
def _connected(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        yield connection


def carry_dose(replaced: Path, restored: Path) -> None:
    """Raise the doses in the restored tables to those in the replaced ones and in the second copy of the ledger.

    A replaced database that cannot be read has its doses in the copy; a restored one without tables is rebuilt from the
    files, and then gets the doses of the copy. The observed time becomes that of the copy, or of the restored tables if
    theirs is later, as those of another device are. The copies, which have another one, are removed.
    """
    copy = DoseLedgerLog(replaced.parent).newest()
    state = copy or DoseLedgerState()
    if replaced.exists():
        with suppress(sqlite3.DatabaseError), _connected(replaced) as tables:
            _raise_to(state, _ledger_in(tables), with_time=copy is None)
    with _connected(restored) as tables:
        tables.execute("PRAGMA journal_mode = DELETE")
        if "observed_time" not in {name for (name,) in tables.execute("SELECT name FROM sqlite_schema")}:
            return
        _raise_to(state, _ledger_in(tables))
        _raise_to(state, DoseLedgerLog(restored.parent).newest() or DoseLedgerState(), with_time=False)
        tables.execute("BEGIN IMMEDIATE")
        for (eye, interval), dose_j_per_cm2 in state.doses.items():
            tables.execute(
                "INSERT OR REPLACE INTO doses (eye, interval, dose_j_per_cm2) VALUES (?, ?, ?)",
                (eye, interval, dose_j_per_cm2),
            )
        tables.execute(
            "INSERT OR REPLACE INTO observed_time (id, boot, now_s, observed_s) VALUES (1, ?, ?, ?)",
            (state.boot, state.now_s, state.observed_s),
        )
        tables.execute("COMMIT")
    for folder in (replaced.parent, restored.parent):
        (folder / LOG).unlink(missing_ok=True)


def _raise_to(state: DoseLedgerState, other: DoseLedgerState, with_time: bool = True) -> None:
    raise_doses(state, other)
    if with_time and other.observed_s > state.observed_s:
        state.observed_s, state.boot, state.now_s = other.observed_s, other.boot, other.now_s


def _ledger_in(tables: sqlite3.Connection) -> DoseLedgerState:
    """Return the dose ledger in a database; sqlite3.DatabaseError if it has none."""
    rows = tables.execute("SELECT eye, interval, dose_j_per_cm2 FROM doses").fetchall()
    time = tables.execute("SELECT observed_s, boot, now_s FROM observed_time").fetchone() or (0.0, "", 0.0)
    return DoseLedgerState({(eye, interval): dose for eye, interval, dose in rows if eye in EYES}, *time)


def _number(tables: sqlite3.Connection, pragma: str) -> int:
    return int(tables.execute(f"PRAGMA {pragma}").fetchone()[0])


def _refuse_damaged(path: Path) -> None:
    try:
        with _connected(path) as tables:
            result = tables.execute("PRAGMA integrity_check").fetchone()[0]
    except sqlite3.DatabaseError as error:
        result = str(error)
    if result != "ok":
        raise StoreDamaged(f"{path.name} is damaged: {result}", "Choose another snapshot.")


def refuse_in_use(database: Path) -> None:
    """Raise StoreError if another process has the database open: then its journal mode cannot be changed to DELETE.

    A missing or unreadable database is no error, because it may be replaced.
    """
    if not database.exists():
        return
    with _connected(database) as tables:
        try:
            tables.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError as error:
            raise StoreError("the instrument is running", "Stop it first: systemctl stop diffuscope.") from error
        except sqlite3.DatabaseError:
            return  # unreadable: to be replaced
