"""Pictures that were pressed for and are not kept yet, by their visit: whoever finishes a visit waits for them."""

from collections import defaultdict
from concurrent.futures import Future, wait
from threading import Lock

from device.values import Capture

LONGEST_S = 60.0  # a picture that takes longer than this will not come


class Promised:
    """What the exam has promised; any thread may ask."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._futures: dict[str, set[Future[Capture]]] = defaultdict(set)

    def add(self, visit: str, future: Future[Capture]) -> None:
        """A picture of this visit is being made."""
        with self._lock:
            self._futures[visit].add(future)
        future.add_done_callback(lambda done: self._forget(visit, done))

    def wait(self, visit: str) -> None:
        """Until every picture of this visit is kept, or failed: both its own press is told."""
        with self._lock:
            under_way = set(self._futures.get(visit, ()))
        wait(under_way, LONGEST_S)

    def _forget(self, visit: str, future: Future[Capture]) -> None:
        with self._lock:
            self._futures[visit].discard(future)
            if not self._futures[visit]:
                del self._futures[visit]
