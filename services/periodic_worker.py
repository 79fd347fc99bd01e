"""Background thread that repeats one step: the loop of alerts, upload and checkpoints."""

import logging
from collections.abc import Callable
from threading import Event, Thread

from device.errors import StoreError

log = logging.getLogger(__name__)


class PeriodicWorker:
    """Daemon thread that calls `step` every `interval_s` seconds, first after one interval, until it is closed.

    After `wake` the next step comes at once, and also after a step that returned True. A StoreError of a step is logged
    with the text `failure`, and the thread goes on: it is transient, or reported by the health checks.
    """

    def __init__(self, name: str, step: Callable[[], bool], interval_s: float, failure: str) -> None:
        self.closing = Event()
        self._name, self._step, self._interval_s, self._failure = name, step, interval_s, failure
        self._wake = Event()
        self._thread: Thread | None = None

    @property
    def has_failed(self) -> bool:
        """Whether the thread was started and has ended without `close`."""
        return self._thread is not None and not self._thread.is_alive() and not self.closing.is_set()

    def begin(self) -> None:
        """Start the thread."""
        self.closing.clear()
        self._wake.clear()
        self._thread = Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Let the next step come at once."""
        self._wake.set()

    def close(self, timeout_s: float | None = None) -> None:
        """Stop the thread and wait for its end, at most `timeout_s` seconds (None: without a limit).

        A thread that does not end in time is logged; it is a daemon, and ends with the process.
        """
        self.closing.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(timeout=timeout_s)
            if self._thread.is_alive():
                log.warning("thread %s did not end within %.1f s", self._thread.name, timeout_s)

    def _run(self) -> None:
        repeat = False
        while not self.closing.is_set():
            if not repeat:
                self._wake.wait(self._interval_s)
                self._wake.clear()
                if self.closing.is_set():
                    return
            try:
                repeat = self._step()
            except StoreError as error:
                log.warning("%s: %s", self._failure, error, extra={"code": error.code})
                repeat = False
