"""Refraction of one frame, estimated in a thread while other work goes on: exposures, or rounds of a solver."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from threading import Lock

from device.clock import Clock, Deadline
from device.recon.estimation.refraction.estimator import NoRefraction, Refraction, RefractionEstimator
from device.recon.model.kernels import Pixels, Places

POLL_S = 0.02  # so often a wait looks at the clock of its deadline


class RefractionTask:
    """Estimation of mean sphere and field edge of a frame and, `with_cylinder`, of its cylinder; begins at once.

    `frame`: counts, dark frame and defects, as for `RefractionEstimator.find`. Tasks with the same `lock` run one after
    the other: an estimator holds the state of one frame. `took` gets the duration of the search for the mean sphere in
    seconds, also after the deadline of its frame. Any thread may ask for the results.
    """

    def __init__(
        self,
        estimator: RefractionEstimator,
        lock: Lock,
        clock: Clock,
        frame: tuple[Pixels, Pixels | None, Places | None],
        with_cylinder: bool,
        took: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        self._took = took
        self._estimator, self._lock, self._clock, self._frame = estimator, lock, clock, frame
        self.cylinder_s = self.join_s = 0.0  # durations, once the results are there
        aside = ThreadPoolExecutor(1, "refraction")
        self._found = aside.submit(self._find, frame)
        self._whole = self._last = aside.submit(self._finish, with_cylinder)
        aside.shutdown(wait=False)

    def join(self, others: Sequence[Pixels]) -> None:
        """Begin to join the refraction with that of the other frames of a burst, once the cylinder is known.

        They have the dark frame of the first one.
        """
        aside = ThreadPoolExecutor(1, "refraction-burst")
        self._last = aside.submit(self._join, others)
        aside.shutdown(wait=False)

    @property
    def has_found(self) -> bool:
        """Whether `found` returns without waiting."""
        return self._found.done()

    @property
    def is_done(self) -> bool:
        """Whether `whole` returns without waiting."""
        return self._last.done()

    def has_found_by(self, until: Deadline | None) -> bool:
        """Wait for the refraction without its cylinder, at most until a deadline; return whether it is there."""
        return _is_done_by(self._found, until)

    def is_done_by(self, until: Deadline | None) -> bool:
        """Wait for `whole`, at most until a deadline; return whether it is there."""
        return _is_done_by(self._last, until)

    def found(self) -> Refraction | NoRefraction:
        """Wait for the refraction without its cylinder."""
        return self._found.result()

    def latest(self) -> Refraction | NoRefraction:
        """Wait for the mean sphere M; return the newest result: joined, with cylinder or M alone, or a refusal."""
        futures: tuple[Future[Refraction | NoRefraction], ...] = self._last, self._whole
        return next((future for future in futures if future.done()), self._found).result()

    def best(self) -> Refraction | NoRefraction:
        """Wait for the mean sphere M; return the newest refraction so far, NoRefraction if M is refused."""
        futures: tuple[Future[Refraction | NoRefraction], ...] = self._last, self._whole
        known = (future.result() for future in futures if future.done())
        return next((result for result in known if isinstance(result, Refraction)), self._found.result())

    def whole(self) -> Refraction | NoRefraction:
        """Wait for the refraction, with its cylinder if the task has one, and joined if `join` was called."""
        return self._last.result()

    def _find(self, frame: tuple[Pixels, Pixels | None, Places | None]) -> Refraction | NoRefraction:
        self._lock.acquire()  # `_finish` releases it, in the same thread
        begin_s = self._clock.now_s()
        found = self._estimator.find(*frame)
        self._took(self._clock.now_s() - begin_s)
        return found

    def _finish(self, with_cylinder: bool) -> Refraction | NoRefraction:
        try:
            found = self._found.result()
            if not (with_cylinder and isinstance(found, Refraction)):
                return found
            begin_s = self._clock.now_s()
            whole = self._estimator.add_cylinder(found)
            self.cylinder_s = self._clock.now_s() - begin_s
            return whole
        finally:
            self._lock.release()

    def _join(self, others: Sequence[Pixels]) -> Refraction | NoRefraction:
        first = self._whole.result()
        if not isinstance(first, Refraction):
            return first
        counts, dark, _ = self._frame
        with self._lock:
            begin_s = self._clock.now_s()
            joined = self._estimator.join(first, (counts, *others), dark)
            self.join_s = self._clock.now_s() - begin_s
        return joined


def _is_done_by(future: Future[Refraction | NoRefraction], until: Deadline | None) -> bool:
    while until is not None and not future.done() and (left_s := until.left_s()) > 0:
        wait([future], min(left_s, POLL_S))
    if until is None:
        wait([future])
    return future.done()
