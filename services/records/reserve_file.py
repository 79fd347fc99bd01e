"""Reserve file: space that is given back on a full disk, so that the last writes can end.

A press needs 200 MB of free space (`atomic_io.RESERVE_BYTES`), but other programs may fill the disk. Then the dose of
an exposure, the answers of a visit and its end still have to be written: the file is removed, and written again by an
opening of the store once there is room.
"""

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from device import atomic_io
from device.errors import StoreFull

log = logging.getLogger(__name__)

NAME = "reserve.bin"
LENGTH_BYTES = 8_000_000
Result = TypeVar("Result")


class ReserveFile:
    """Reserve file of the store in `folder`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME

    def allocate_if_room(self, reserve_bytes: int, free_bytes: int) -> None:
        """Write the file if it is missing or too short and fits beside `reserve_bytes`; none if nothing is reserved.

        A refusal of the disk is only logged: the store works without the file.
        """
        if not reserve_bytes or self._is_whole() or not atomic_io.has_room(LENGTH_BYTES, free_bytes, reserve_bytes):
            return
        try:
            self._allocate()
        except OSError as error:
            log.warning("no space is reserved for the last writes: %s", error)
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def _is_whole(self) -> bool:
        return self._path.exists() and self._path.stat().st_size == LENGTH_BYTES

    def _allocate(self) -> None:
        descriptor = atomic_io.private_opener(self._path, os.O_WRONLY | os.O_CREAT)
        try:
            os.posix_fallocate(descriptor, 0, LENGTH_BYTES)  # a file of zeros might need no space
        finally:
            os.close(descriptor)
        atomic_io.fsync_file(self._path)
        atomic_io.fsync_folder(self._path.parent)

    def release(self) -> bool:
        """Remove the file; return whether there was one. OSError if the disk refuses."""
        if not self._path.exists():
            return False
        self._path.unlink()
        atomic_io.fsync_folder(self._path.parent)
        return True

    def retried(self, write: Callable[[], Result]) -> Result:
        """Run a write that must end; on a full disk release the file and run it once more. StoreFull without a file."""
        try:
            return write()
        except StoreFull:
            if not self.release():
                raise
            return write()
