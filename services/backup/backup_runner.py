"""Backup of the running instrument, started on the technician's page: one at a time, in a background thread."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread

from device.clock import Clock
from device.errors import DiffuscopeError, StoreError
from services.backup.backup_key import LastBackup, key_for_passphrase, read_key, write_key
from services.backup.write_backup import write_backup
from services.errors import Busy, StoreDamaged
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

UNREADABLE = "Everything else is in the backup. The memory card fails: call the technician, and replace it."
PAUSE_S = 0.2  # between two looks whether the exam still computes


@dataclass(frozen=True)
class BackupState:
    """State of the backups: whether a key is set, the last backup, and progress or error of the present one.

    `progress`: folders of the store that are in the backup, and of all; None if none is under way.
    """

    has_key: bool
    last: LastBackup | None
    progress: tuple[int, int] | None
    error: DiffuscopeError | None


class BackupRunner:
    """Runs backups of the store in `folder`; it pauses while `is_idle` is false, so that no exam is slower.

    `is_idle` is called in the thread of the backup.
    """

    def __init__(self, folder: Path, is_idle: Callable[[], bool], clock: Clock) -> None:
        self._folder, self._is_idle, self._clock = folder, is_idle, clock
        self._lock = Lock()  # of the three values below; never held during a backup
        self._thread: Thread | None = None
        self._progress: tuple[int, int] | None = None
        self._error: DiffuscopeError | None = None
        self._closing = Event()

    def state(self) -> BackupState:
        """Return the present state; BackupDamaged if the key of the backups cannot be read."""
        key = read_key(self._folder)
        with self._lock:
            return BackupState(key is not None, key.last if key else None, self._progress, self._error)

    def set_passphrase(self, passphrase: str) -> None:
        """Make the key of the next backups, in a folder of their own; Busy during a backup, BackupKeyWrong if short."""
        with self._lock:
            self._refuse_busy()
        with storage_errors():
            write_key(self._folder, key_for_passphrase(passphrase))

    def begin(self, place: Path) -> None:
        """Begin a backup to a folder, with the errors of `write_backup` in the state; Busy during another one."""
        with self._lock:
            self._refuse_busy()
            self._progress = (0, 0)
            self._error = None
            self._thread = Thread(target=self._run, args=(place,), name="backup", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop a backup between two files and wait for its end; the next one continues it."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def _refuse_busy(self) -> None:
        if self._progress is not None:
            raise Busy("a backup is under way", "Wait until it has ended.")

    def _run(self, place: Path) -> None:
        error: DiffuscopeError | None = None
        try:
            made = write_backup(self._folder, place, self._clock, self._report)
            log.info("backup %s: %s folders, %s bytes written", made.number, made.units, made.written_bytes)
            if made.unreadable:
                listed = ", ".join(made.unreadable[:5])
                error = StoreDamaged(f"{len(made.unreadable)} folders are not in the backup: {listed}", UNREADABLE)
        except DiffuscopeError as problem:
            log.warning("the backup failed: %s", problem)
            error = problem
        finally:
            with self._lock:
                self._progress = None
                self._error = error

    def _report(self, done: int, total: int) -> None:
        """Store the progress, and wait until the exam is idle; StoreError if the program ends."""
        with self._lock:
            self._progress = (done, total)
        while not self._closing.is_set() and not self._is_idle():
            self._closing.wait(PAUSE_S)
        if self._closing.is_set():
            raise StoreError("the program ended during the backup", "Begin it again: it continues.")
