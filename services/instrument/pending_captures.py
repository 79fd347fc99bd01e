"""Pending captures by visit: the request that finishes a visit waits for them."""

from collections import defaultdict
from concurrent.futures import Future, wait
from threading import Lock

from services.records.capture import Capture

TIMEOUT_S = 60.0  # timeout of `wait`


class PendingCaptures:
    """Futures of the captures in progress, by visit. The mutex `_lock` guards `_futures`; thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._futures: dict[str, set[Future[Capture]]] = defaultdict(set)

    def add(self, visit: str, future: Future[Capture]) -> None:
        """Register a capture of a visit until its future is done."""
        with self._lock:
            self._futures[visit].add(future)
        future.add_done_callback(lambda done: self._forget(visit, done))

    def wait(self, visit: str) -> None:
        """Wait until every pending capture of a visit is stored or failed; return after TIMEOUT_S at the latest."""
        with self._lock:
            under_way = set(self._futures.get(visit, ()))
        wait(under_way, TIMEOUT_S)

    def _forget(self, visit: str, future: Future[Capture]) -> None:
        with self._lock:
            self._futures[visit].discard(future)
            if not self._futures[visit]:
                del self._futures[visit]
