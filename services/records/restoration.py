"""Replacement of the content of an unused store by a restored one, which a power cut cannot leave half done.

The restored files are complete and durable in `.restored.part/` before it is renamed to `.restored/` (the commit). From
then on each opening of the store moves them into their places until `.restored/` is empty (roll forward). What was
there before is moved to `replaced/`.
"""

import shutil
from pathlib import Path

from device import atomic_io
from services.records import schema
from services.records.snapshots import LOG_SUFFIXES

PART, READY, REPLACED = ".restored.part", ".restored", "replaced"


def begin_restoration(store: Path) -> Path:
    """Create and return an empty folder for the restored files; OSError if the disk refuses."""
    part = store / PART
    shutil.rmtree(part, ignore_errors=True)  # left by an interrupted restoration
    atomic_io.make_folder(part)
    return part


def commit_restoration(store: Path) -> None:
    """Commit the durable restored files, and move them into place; the caller has the lock of the store."""
    atomic_io.replace_durably(store / PART, store / READY)
    finish_restoration(store)


def finish_restoration(store: Path) -> None:
    """Move committed restored files into their places; no-op without them. OSError if the disk refuses.

    The logs of a replaced database are moved before it: SQLite would apply them to the restored one. The database is
    moved last, so that it never lists files that are not in place yet.
    """
    ready = store / READY
    if not ready.is_dir():
        return
    for suffix in LOG_SUFFIXES:
        _move_aside(store / f"{schema.DATABASE}-{suffix}")
    for restored in sorted(ready.iterdir(), key=lambda path: (path.name == schema.DATABASE, path.name)):
        _move_aside(store / restored.name)
        atomic_io.replace_durably(restored, store / restored.name)
    ready.rmdir()
    atomic_io.fsync_folder(store)


def _move_aside(present: Path) -> None:
    if not present.exists():
        return
    folder = present.parent / REPLACED
    atomic_io.make_folder(folder)
    atomic_io.quarantine(present, folder)
    atomic_io.fsync_folder(folder)
    atomic_io.fsync_folder(present.parent)
