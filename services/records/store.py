"""The shelf: a capture is on it whole or not at all, whatever happens in between.

    shelf.sqlite                  what was kept: rows
    shelf.sqlite-wal              rows that are not in the main file yet (`checkpoint`)
    captures/<id>/<name>          and their files
    captures/.<id>.part/          being written; no row yet
    torn/<id>/                    incomplete at an opening: not listed, kept for the technician until space is needed
    snapshots/                    the tables as they were before each migration (snapshots.py)

The row is the promise: it is written last, when every file it names is on the disk. A folder that has all files of a
capture and no row may have lost its row: it is neither moved nor removed, and `orphans` names it.
"""

import hashlib
import logging
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from sqlalchemy import distinct, func, select
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from device.clock import Clock, SystemClock
from device.errors import NotKept, SettingError, StoreDamaged, StoreError, StoreFull
from device.values import Capture
from services.records import captures, disk, schema
from services.records.errand import Beside
from services.records.reading import REMEDY, readable
from services.records.schema import CaptureRow, FileRow, ShotRow, VisitRow
from services.records.snapshots import Snapshots

log = logging.getLogger(__name__)

WHOLE = frozenset({"raw.tiff", "dark.tiff", "picture.png", "quick.jpg", "report.json"})  # of every release's captures
LATELY = 100  # visits by which the next ones are judged
ESTIMATE_BYTES = 10_000_000  # a capture before there was one to measure: 4 megapixels of raw, pressed, and a picture
PAGE = 500  # rows that are read at once where all are


class Store:
    """Captures kept in one folder; opening it brings the tables up to date and moves half-kept captures aside.

    `swept` names what was moved, as found in `torn/`. Any thread may read while one keeps; keepers wait for each other.
    Opening and closing write the rows of the log into the main file.
    """

    swept: tuple[str, ...]

    def __init__(
        self,
        folder: Path,
        *,
        reserve_bytes: int = disk.RESERVE_BYTES,
        free_bytes: Callable[[Path], int] = disk.free_bytes,
        clock: Clock | None = None,
    ) -> None:
        self.folder = folder
        self._captures, self._torn, self._lock = folder / "captures", folder / "torn", folder / ".lock"
        self._reserve_bytes, self._free_bytes = reserve_bytes, free_bytes
        self._sizes: tuple[int, int] | None = None  # bytes and captures; counted once, for each status asks for it
        with told(), ExitStack() as undo:
            disk.make_folder(self._captures)
            disk.make_folder(self._torn)
            snapshots = Snapshots(folder / "shelf.sqlite", clock or SystemClock(), free_bytes)
            self.engine = schema.open_engine(folder / "shelf.sqlite")
            undo.callback(self.engine.dispose)
            with disk.alone(self._lock):  # a capture that another process is keeping is not a torn one
                self._refuse_to_begin_anew()
                schema.migrate(self.engine, snapshots.make)
                self.swept = self._sweep()
                self._checkpoint_if_possible()
            undo.pop_all()

    def close(self) -> None:
        """Write the log's rows into the main file, if the disk lets it, and let go of the database."""
        self._checkpoint_if_possible()
        self.engine.dispose()

    def checkpoint(self) -> bool:
        """Write the log's rows into the main file and empty the log; False if somebody reads or writes meanwhile.

        Until then a row is in the log alone, where one wrong byte loses every row behind it without an error.
        """
        if self.log_bytes() == 0:
            return True
        with told():
            return schema.checkpoint(self.engine)

    def _checkpoint_if_possible(self) -> None:
        try:
            self.checkpoint()
        except StoreError as error:  # nothing is lost: the rows stay in the log
            log.warning("the log of the database stays: %s", error)

    def log_bytes(self) -> int:
        """The length of the log."""
        try:
            return (self.folder / "shelf.sqlite-wal").stat().st_size
        except FileNotFoundError:
            return 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def keep(self, capture: Capture, files: Mapping[str, bytes], beside: Beside | None = None) -> Capture:
        """Keep a capture and its files by name, and return it with their SHA-256 once no power cut can undo it.

        What `beside` writes is kept with it, or not at all.
        Errors: StoreFull (nothing is left of it), StoreError (the next opening judges what was written by its row),
        SettingError (a name or report that cannot be kept).
        """
        _refuse_names(capture.id, files)
        capture = capture.with_files({name: hashlib.sha256(content).hexdigest() for name, content in files.items()})
        row = schema.row_of(capture, {name: len(content) for name, content in files.items()})
        part, kept = self._captures / f".{capture.id}.part", self._captures / capture.id
        with told(), disk.alone(self._lock):
            self._refuse_twice(part, kept)
            self._refuse_without_room(sum(map(len, files.values())))
            with _nothing_left_when_full(part, kept):
                disk.write_folder(part, files)
                part.rename(kept)
                disk.settle(self._captures)
                with Session(schema.for_writing(self.engine)) as session, session.begin():
                    session.add(row)
                    if beside is not None:
                        session.flush()
                        beside(session, capture)
        if self._sizes is not None:
            self._sizes = self._sizes[0] + sum(map(len, files.values())), self._sizes[1] + 1
        return capture

    def captures(self, limit: int = 50, before: str | None = None) -> list[Capture]:
        """The newest captures, newest first; with `before`, those kept before the capture of that name (NotKept).

        In the order in which they were kept, whatever the date was set to meanwhile; without those that `damaged`
        counts.
        """
        if limit < 1:
            raise SettingError(f"a list of {limit} captures is not a list", "Ask for one capture or more.")
        out: list[Capture] = []
        with self._reading() as session:
            for page in _pages(session, limit, None if before is None else _row(session, before).kept):
                out += page.captures
                if len(out) >= limit:
                    break
        return out[:limit]

    def damaged(self) -> int:
        """How many captures have an entry that cannot be read: they are not listed, and asked for alone are refused."""
        with self._reading() as session:
            return sum(page.damaged for page in _pages(session, PAGE))

    def get(self, id: str) -> Capture:
        """The capture of that name; NotKept if there is none, StoreDamaged if its entry is or its folder is gone."""
        with self._reading() as session:
            row = _row(session, id)
            capture = captures.capture_of(row, captures.files_of(session, [row]))
        if not (self._captures / capture.id).is_dir():
            raise StoreDamaged(f"the folder of {capture.id} is gone")
        return capture

    def read(self, id: str, name: str) -> bytes:
        """One file of a capture, exactly as it was kept; NotKept if there is none, StoreDamaged if it changed."""
        with self._reading() as session:
            row = _row(session, id)
            files = dict(captures.files_of(session, [row]).get(row.id, ()))
        if name not in files:
            raise NotKept(f"{id} has no file named {name!r}")
        # The path is built from the row alone: a name from outside never touches the disk.
        try:
            content: bytes = (self._captures / row.id / name).read_bytes()
        except OSError as error:
            raise StoreDamaged(f"{name} of {id} cannot be read: {error}") from error
        if hashlib.sha256(content).hexdigest() != files[name]:
            raise StoreDamaged(f"{name} of {id} is not what was kept: its SHA-256 differs")
        return content

    def people_left(self, pictures: int) -> int:
        """How many more visits will fit: like the last hundred that were finished, or of `pictures` captures each."""
        lately = select(VisitRow.id).where(VisitRow.finished_at.is_not(None)).order_by(VisitRow.begun_at.desc())
        sizes = (
            select(func.coalesce(func.sum(FileRow.bytes), 0), func.count(distinct(ShotRow.visit)))
            .join(ShotRow, ShotRow.capture == FileRow.capture_id)
            .where(ShotRow.visit.in_(lately.limit(LATELY)))
        )
        with self._reading() as session:
            total_bytes, number = session.execute(sizes).one()
        return self._room_bytes() * number // total_bytes if total_bytes else self.space_left() // pictures

    def torn(self) -> dict[str, int]:
        """Return the incomplete captures in `torn/` and their bytes, oldest first; deleted if a capture needs space."""
        places = [place for place in sorted(self._torn.iterdir()) if not _is_whole(place)]
        return {place.name: disk.size_bytes(place) for place in places}

    def orphans(self) -> list[str]:
        """Return the names of the capture folders without a row that have all files: not listed, and never removed.

        Those that an earlier release moved to `torn/` are included.
        """
        with told(), disk.alone(self._lock):  # one that is being kept gets its row
            folders = [*self._strays(), *self._torn.iterdir()]
            return sorted(folder.name for folder in folders if _is_whole(folder))

    def _room_bytes(self) -> int:
        free_bytes = self._free_bytes(self.folder) + sum(self.torn().values())
        return max(0, free_bytes - self._reserve_bytes)

    def space_left(self) -> int:
        """How many more captures will fit, judged by the mean size so far."""
        if self._sizes is None:
            every = select(func.coalesce(func.sum(FileRow.bytes), 0), func.count(distinct(FileRow.capture_id)))
            with self._reading() as session:
                total_bytes, number = session.execute(every).one()
            self._sizes = total_bytes, number
        total_bytes, number = self._sizes
        mean_bytes = max(1, total_bytes // number) if number else ESTIMATE_BYTES
        return self._room_bytes() // mean_bytes

    def try_out(self) -> None:
        """Write a small file as a capture's would be, and remove it; StoreFull or StoreError if the disk refuses."""
        trial = self.folder / ".trial"
        with told(), disk.alone(self._lock):
            shutil.rmtree(trial, ignore_errors=True)  # of a trial that was killed
            disk.write_folder(trial, {"trial": b"written and removed"})
            shutil.rmtree(trial)

    @contextmanager
    def _reading(self) -> Iterator[Session]:
        with told(), Session(self.engine) as session:
            yield session

    def _refuse_to_begin_anew(self) -> None:
        """Refuse to open without the database that the captures belong to: a new one would call all of them torn."""
        database = self.folder / "shelf.sqlite"
        missing = not database.exists() or database.stat().st_size == 0
        if missing and any(not path.name.startswith(".") for path in self._captures.iterdir()):
            raise StoreDamaged(f"{database} is gone, and there are captures that it should list")

    def _strays(self) -> list[Path]:
        """Return every capture folder without a row."""
        with Session(self.engine) as session:
            kept = set(session.scalars(select(CaptureRow.id)))
        return sorted(path for path in self._captures.iterdir() if path.is_dir() and path.name not in kept)

    def _sweep(self) -> tuple[str, ...]:
        """Move every incomplete capture folder without a row to `torn/`; return the names."""
        half = [stray for stray in self._strays() if stray.name.startswith(".") or not _is_whole(stray)]
        swept = tuple(disk.move_aside(stray, self._torn) for stray in half)
        if swept:
            disk.settle(self._torn)
            disk.settle(self._captures)
        return swept

    def _refuse_without_room(self, need_bytes: int) -> None:
        """StoreFull, after what is torn gave its room up, the oldest first: a whole picture is worth more than half."""
        torn = iter(self.torn())
        while (free := self._free_bytes(self.folder)) < need_bytes + self._reserve_bytes:
            if (name := next(torn, None)) is None:
                wanted = f"{need_bytes} and a reserve of {self._reserve_bytes} are needed"
                raise StoreFull(f"{free} bytes are free; {wanted}")
            disk.remove(self._torn / name)
            log.warning("the half-kept capture %s was removed: a new one needs its room", name)

    def _refuse_twice(self, *folders: Path) -> None:
        for folder in folders:
            if folder.exists():
                raise StoreError(f"{folder.name} is on the shelf already", "Take the picture again.")


def _is_whole(folder: Path) -> bool:
    return folder.is_dir() and {path.name for path in folder.iterdir()} >= WHOLE


@dataclass(frozen=True)
class _Page:
    """Some captures, newest first, and how many more there are among them whose entry cannot be read."""

    captures: list[Capture]
    damaged: int


def _pages(session: Session, size: int, before: int | None = None) -> Iterator[_Page]:
    """All captures, newest first, in pages of `size` rows; `before` is the row number of the one that ends them."""
    while True:
        query = captures.CAPTURES.order_by(schema.KEPT.desc()).limit(size)
        rows = captures.capture_rows(session, query if before is None else query.where(before > schema.KEPT))
        if not rows:
            return
        files = captures.files_of(session, rows)
        found = readable(rows, lambda row: captures.capture_of(row, files))  # noqa: B023  # called at once
        yield _Page(found, len(rows) - len(found))
        before = rows[-1].kept


def _row(session: Session, id: str) -> captures.CaptureColumns:
    """The row of a capture, of CAPTURES; NotKept if there is none, StoreDamaged if the name in it is another."""
    known = captures.NAME.fullmatch(id) is not None
    rows = captures.capture_rows(session, captures.CAPTURES.where(CaptureRow.id == id)) if known else []
    if not rows:
        raise NotKept(f"there is no capture named {id!r}")
    row = rows[0]
    if row.id != id:  # found by the index, which still says what the row no longer does
        raise StoreDamaged(f"the entry of {id!r} has another name", REMEDY)
    return row


def _refuse_names(id: str, files: Mapping[str, bytes]) -> None:
    for name in (id, *files):
        if not captures.NAME.fullmatch(name):
            raise SettingError(f"{name!r} cannot name something kept", "Use letters, digits, dots and hyphens.")
    if not files:
        raise SettingError(f"{id} has no files, so there is nothing to keep")


@contextmanager
def _nothing_left_when_full(*folders: Path) -> Iterator[None]:
    """When the disk is full, make room again by removing what was begun.

    After any other failure the folders stay for the next opening to judge by the row: only then is it known whether a
    commit that failed in its last step reached the disk.
    """
    try:
        yield
    except (OSError, DBAPIError) as error:
        if _never_committed_for_want_of_room(error):
            for folder in folders:
                shutil.rmtree(folder, ignore_errors=True)  # what stays has no row, and is swept
        raise


def _never_committed_for_want_of_room(error: OSError | DBAPIError) -> bool:
    return disk.is_full(error) if isinstance(error, OSError) else _sqlite_name(error) == "SQLITE_FULL"


def _sqlite_name(error: DBAPIError) -> str:
    return getattr(error.orig, "sqlite_errorname", "")


@contextmanager
def told() -> Iterator[None]:
    """Tell errors of the operating system and of SQLite as errors of the shelf."""
    try:
        yield
    except OSError as error:
        kind = StoreFull if disk.is_full(error) else StoreError
        raise kind(f"the disk refused: {error}") from error
    except DBAPIError as error:
        raise _KINDS.get(_sqlite_name(error), StoreError)(f"the database refused: {error.orig}") from error
    except sqlite3.Error as error:
        raise _KINDS.get(error.sqlite_errorname, StoreError)(f"the database refused: {error}") from error


_KINDS: dict[str, type[StoreError]] = {
    "SQLITE_FULL": StoreFull,
    "SQLITE_IOERR_SHMSIZE": StoreFull,  # no room for the index of the write-ahead log
    "SQLITE_CORRUPT": StoreDamaged,
    "SQLITE_NOTADB": StoreDamaged,
}
