"""Checkpoints of the SQLite write-ahead log (WAL) into the main database file while no picture is taken.

In the WAL, one wrong byte loses every row behind it.
"""

import logging
from collections.abc import Callable
from threading import Event, Thread

from device.clock import Clock
from device.errors import StoreError
from services.records.store import Store

log = logging.getLogger(__name__)

IDLE_S = 30.0  # without a press and without aiming, before a checkpoint
LOOK_S = 2.0


class Checkpoints:
    """Background thread that checkpoints the WAL.

    After `soon`: as soon as no picture is being taken (`takes_none`); otherwise: after IDLE_S without a press or aiming
    (`is_idle`).
    """

    def __init__(self, store: Store, is_idle: Callable[[], bool], takes_none: Callable[[], bool], clock: Clock) -> None:
        self._store, self._is_idle, self._takes_none, self._clock = store, is_idle, takes_none, clock
        self._idle_since_s: float | None = None
        self._soon, self._wake, self._closing = Event(), Event(), Event()
        self._thread: Thread | None = None

    def begin(self) -> None:
        """Start the thread, which calls `step` every LOOK_S."""
        self._closing.clear()
        self._thread = Thread(target=self._watch, name="checkpoints", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and wait for its end; `Store.close` makes the last checkpoint."""
        self._closing.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()

    def soon(self) -> None:
        """Request a checkpoint; called after a visit is finished."""
        self._soon.set()
        self._wake.set()

    def step(self) -> bool:
        """Checkpoint the WAL if a condition for it holds; return whether it was emptied."""
        now_s = self._clock.now_s()
        if not self._is_idle():
            self._idle_since_s = None
        elif self._idle_since_s is None:
            self._idle_since_s = now_s
        rests = self._idle_since_s is not None and now_s - self._idle_since_s >= IDLE_S
        if not self._takes_none() or not (rests or self._soon.is_set()) or self._store.log_bytes() == 0:
            return False
        emptied = self._store.checkpoint()
        if emptied:
            self._soon.clear()
        return emptied

    def _watch(self) -> None:
        while not self._closing.is_set():
            try:
                self.step()
            except StoreError as error:  # the rows stay in the log; the next press says what the disk lacks
                log.warning("the log of the database cannot be emptied: %s", error, extra={"code": error.code})
            self._wake.wait(LOOK_S)
            self._wake.clear()
