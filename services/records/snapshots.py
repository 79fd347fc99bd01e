"""The tables as an earlier release left them: copied before every migration, and put back by hand if it must be.

    FOLDER/<schema>-<date>.db     one for each of the last three versions of the tables, whole or not there
    FOLDER/replaced-<n>/          tables in whose place a snapshot was put

A release that is rolled back reads the newer tables (README, "add a column"), so nobody needs these in ordinary life:
they are for a migration that did harm. Only tables are copied; the files of captures never change.
"""

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from device.clock import Clock
from device.errors import NotKept, StoreDamaged, StoreError, StoreFull
from services.records import disk

KEPT = 3
LOGS = ("journal", "wal", "shm")  # SQLite would apply what is left of them to whatever lies beside them
SLACK_BYTES = 10_000_000  # what the system may write meanwhile


class Snapshots:
    """The snapshots of one shelf, in a folder of their own."""

    def __init__(self, shelf: Path, clock: Clock, free_bytes: Callable[[Path], int] = disk.free_bytes) -> None:
        self.shelf, self.folder = shelf, shelf.parent / "snapshots"
        self._clock, self._free_bytes = clock, free_bytes

    def names(self) -> list[str]:
        """Those that there are, the oldest tables first."""
        return sorted(path.name for path in self.folder.glob("*.db"))

    def make(self, schema: str) -> None:
        """Copy the tables, which are of the version `schema`; on the disk when this returns.

        StoreFull if there is no room for the copy and for what the migration writes. A power cut leaves it whole, or
        not there; the next start, which still has the migration before it, makes another in its place.
        """
        disk.make_folder(self.folder)
        name = f"{schema}-{self._clock.wall():%Y%m%dT%H%M%S}.db"
        part = self.folder / ".part"
        part.unlink(missing_ok=True)
        with _connected(self.shelf) as tables:
            size_bytes = _number(tables, "page_count") * _number(tables, "page_size")
            self._refuse_without_room(size_bytes)
            try:
                tables.execute("VACUUM INTO ?", (str(part),))
            except sqlite3.Error:
                part.unlink(missing_ok=True)
                raise
        _settle_file(part)
        part.rename(self.folder / name)
        disk.settle(self.folder)
        self._thin_out(name)

    def put_back(self, name: str) -> Path:
        """Put a snapshot in the place of the tables, and those aside; the folder they are in.

        Errors: NotKept, StoreDamaged (the snapshot is not whole), StoreError (the instrument runs). A power cut in
        between leaves a shelf that refuses to open; putting back once more mends it.
        """
        if name not in self.names():
            raise NotKept(f"there is no snapshot {name!r}", "`diffuscope snapshots list` names them.")
        _refuse_damaged(self.folder / name)
        _refuse_in_use(self.shelf)
        new = self.shelf.with_name(".shelf.part")
        shutil.copyfile(self.folder / name, new)
        _settle_file(new)
        disk.settle(self.shelf.parent)
        aside = self._aside()
        for present in (self.shelf, *(self.shelf.with_name(f"{self.shelf.name}-{log}") for log in LOGS)):
            if present.exists():
                present.rename(aside / present.name)
                disk.settle(aside)
                disk.settle(self.shelf.parent)  # the tables first: without them the shelf refuses to open
        new.rename(self.shelf)
        disk.settle(self.shelf.parent)
        return aside

    def missing_from(self, name: str, captures: Path) -> list[str]:
        """The captures in a folder that a snapshot does not know: kept since."""
        with _connected(self.folder / name) as tables:
            known = {id for (id,) in tables.execute("SELECT id FROM captures")}
        return sorted(path.name for path in captures.glob("[!.]*") if path.name not in known)

    def _aside(self) -> Path:
        number = 1
        while (self.folder / f"replaced-{number}").exists():
            number += 1
        disk.make_folder(self.folder / f"replaced-{number}")
        return self.folder / f"replaced-{number}"

    def _refuse_without_room(self, size_bytes: int) -> None:
        """The reserve of captures may be used: it is there so that the computer can start and be updated."""
        need, free = 2 * size_bytes + SLACK_BYTES, self._free_bytes(self.shelf.parent)
        if free < need:
            raise StoreFull(
                f"{free} bytes are free; {need} are needed to copy the tables before they are changed",
                "No space left, so nothing was changed. Remove files from the disk, or go back to the version before.",
            )

    def _thin_out(self, newest: str) -> None:
        """The last one of each of the last versions stays, and the one just made whatever the clock says."""
        last = {name.split("-")[0]: name for name in (*self.names(), newest)}
        stay = {*sorted(last.values())[-KEPT:], newest}
        for name in self.names():
            if name not in stay:
                (self.folder / name).unlink()


@contextmanager
def _connected(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        yield connection


def _number(tables: sqlite3.Connection, pragma: str) -> int:
    return int(tables.execute(f"PRAGMA {pragma}").fetchone()[0])


def _settle_file(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _refuse_damaged(path: Path) -> None:
    try:
        with _connected(path) as tables:
            said = tables.execute("PRAGMA integrity_check").fetchone()[0]
    except sqlite3.DatabaseError as error:
        said = str(error)
    if said != "ok":
        raise StoreDamaged(f"{path.name} is damaged: {said}", "Choose another snapshot.")


def _refuse_in_use(shelf: Path) -> None:
    """StoreError while anybody else has the tables open; those that cannot be read may be replaced as well."""
    if not shelf.exists():
        return
    with _connected(shelf) as tables:
        try:
            tables.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError as error:
            raise StoreError("the instrument is running", "Stop it first: systemctl stop diffuscope.") from error
        except sqlite3.DatabaseError:
            return  # this is what snapshots are for
