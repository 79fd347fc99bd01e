"""Opening of the store on a disk that takes no changes: full, mounted read-only, failing, or of another user.

The tables and the small files are copied into memory, where they can be migrated and read; captures and calibrations
are read from the disk. Every change is refused with the reason, and with the dose ledger all light. Exports, uploads
and backups work; that they were made is known until the program ends.
"""

import logging
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from device import atomic_io
from device.clock import Clock
from device.errors import StoreError, StoreFull, StoreReadOnly
from services.records.capture_journal import JOURNAL
from services.records.capture_store import CaptureStore
from services.records.reserve_file import NAME, ReserveFile
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)

READ_FROM_DISK = ("captures", "calibrations", "quarantine", "damaged", "conflicts")
NOT_COPIED = frozenset({".lock", NAME, "snapshots", "replaced", "accuracy"})


@contextmanager
def opened_store(folder: Path, clock: Clock, key: bytes | None = None) -> Iterator[CaptureStore]:
    """Open the store in a folder, and close it at exit; read-only if its disk takes no changes; a context manager.

    `key`: as of `CaptureStore`. On a full disk the reserve file is released first. Errors: those of `CaptureStore`, if
    the disk can be written or if it cannot be read either.
    """
    try:
        store = _opened(folder, clock, key)
    except (StoreFull, StoreReadOnly) as refusal:
        log.error("the store is opened for reading only: %s", refusal.message)
        with _copy_opened(folder, clock, refusal, key) as copy:
            yield copy
        return
    with store:
        yield store


def _opened(folder: Path, clock: Clock, key: bytes | None) -> CaptureStore:
    """Open the store for reading and writing; on a full disk once more without the reserve file."""
    with storage_errors():
        return ReserveFile(folder).retried(lambda: CaptureStore(folder, clock=clock, key=key))


@contextmanager
def _copy_opened(folder: Path, clock: Clock, refusal: StoreError, key: bytes | None) -> Iterator[CaptureStore]:
    with ExitStack() as undo:
        with storage_errors():
            in_memory = atomic_io.memory_folder()  # the folder of temporary files may be on the disk that refuses
            place = Path(undo.enter_context(TemporaryDirectory(prefix="diffuscope-", dir=in_memory)))
            for source in sorted(folder.iterdir()):
                _copy(source, place / source.name)
        store = CaptureStore(place, reserve_bytes=0, free_bytes=lambda _: 0, clock=clock, refusal=refusal, key=key)
        yield undo.enter_context(store)


def _copy(source: Path, target: Path) -> None:
    """Copy a file or folder of the store, or link what is read from the disk; nothing for what is not needed."""
    if source.name in READ_FROM_DISK:
        target.symlink_to(source.absolute())
    elif source.is_dir() and source.name not in NOT_COPIED:
        shutil.copytree(source, target, ignore=_no_frames if source.name == JOURNAL else None)
    elif source.name not in NOT_COPIED:
        shutil.copy(source, target)


def _no_frames(folder: str, names: list[str]) -> list[str]:
    """Return the folders of frames in the journal, which are not resumed and need not be in memory."""
    return [name for name in names if (Path(folder) / name).is_dir()]
