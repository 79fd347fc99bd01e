"""Checkpoints of the SQLite write-ahead log (WAL) into the main database file while no capture is in progress.

A wrong byte in the WAL loses every later row, so rows stay in it for a short time only.
"""

from collections.abc import Callable
from threading import Event

from device.clock import Clock
from services.periodic_worker import PeriodicWorker
from services.records.capture_store import CaptureStore

IDLE_S = 30.0  # time without a press and live pictures before a checkpoint
LOOK_S = 2.0


class Checkpoints:
    """Background thread that checkpoints the WAL.

    After `request`: as soon as no capture is in progress (`is_capture_free`); otherwise after IDLE_S without a press
    or live pictures (`is_idle`).
    """

    def __init__(
        self, store: CaptureStore, is_idle: Callable[[], bool], is_capture_free: Callable[[], bool], clock: Clock
    ) -> None:
        self._store, self._is_idle, self._takes_none, self._clock = store, is_idle, is_capture_free, clock
        self._idle_since_s: float | None = None
        self._soon = Event()
        self._worker = PeriodicWorker("checkpoints", self._look, LOOK_S, "WAL checkpoint failed")

    def begin(self) -> None:
        """Start the thread, which calls `step` every LOOK_S."""
        self._worker.begin()

    def close(self) -> None:
        """Stop the thread and wait for its end; `CaptureStore.close` makes the last checkpoint."""
        self._worker.close()

    def request(self) -> None:
        """Request a checkpoint; called after a visit is finished."""
        self._soon.set()
        self._worker.wake()

    def step(self) -> bool:
        """Checkpoint a WAL that is not empty if a condition of the class holds; return whether this emptied the WAL.

        Raises StoreError if the disk fails.
        """
        now_s = self._clock.now_s()
        if not self._is_idle():
            self._idle_since_s = None
        elif self._idle_since_s is None:
            self._idle_since_s = now_s
        is_at_rest = self._idle_since_s is not None and now_s - self._idle_since_s >= IDLE_S
        if (
            not self._takes_none()
            or not (is_at_rest or self._soon.is_set())
            or self._store.write_ahead_log.length_bytes() == 0
        ):
            return False
        emptied = self._store.write_ahead_log.checkpoint()
        if emptied:
            self._soon.clear()
        return emptied

    def _look(self) -> bool:
        self.step()
        return False
