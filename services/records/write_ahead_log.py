"""Write-ahead log (WAL) of the database: its length, and checkpoints, which move its rows into the main file."""

import logging
from pathlib import Path

from sqlalchemy import Engine

from device.errors import StoreError
from services.records import schema
from services.records.storage_errors import storage_errors

log = logging.getLogger(__name__)


class WriteAheadLog:
    """Write-ahead log of one SQLite file, `<database>-wal`."""

    def __init__(self, database: Path, engine: Engine) -> None:
        self._path = database.with_name(f"{database.name}-wal")
        self._engine = engine

    def checkpoint(self) -> bool:
        """Move all rows of the write-ahead log into the main file and truncate the log.

        Return True if the log is empty afterwards, False if another connection was busy. Before a checkpoint a row is
        in the log only, where one wrong byte loses that row and every later one without an error. Errors: StoreError.
        """
        if self.length_bytes() == 0:
            return True
        with storage_errors():
            return schema.checkpoint(self._engine)

    def checkpoint_if_possible(self) -> None:
        """Checkpoint the log; a failure is only logged, because the rows stay in the log."""
        try:
            self.checkpoint()
        except StoreError as error:
            log.warning("checkpoint of the write-ahead log failed: %s", error)

    def length_bytes(self) -> int:
        """Return the length of the write-ahead log in bytes; 0 without a log."""
        try:
            return self._path.stat().st_size
        except FileNotFoundError:
            return 0
