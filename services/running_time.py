"""Lines of progress while a command computes: what it does and for how long, and whether kernels are compiled."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from numba.core import event

from device.clock import Clock

FIRST_S, NEXT_S, LATER_S = 1.0, 3.0, 10.0  # after the start; then every LATER_S
COMPILING = "compiling kernels, which this computer then keeps"


class RunningTime(event.Listener):
    """Durations of a computation in seconds: of all of it, and of the compilation of kernels within it."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._begin_s = clock, clock.now_s()
        self._depth, self._compile_begin_s = 0, 0.0
        self.compiles, self.compiled_s = False, 0.0

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return self._clock.now_s() - self._begin_s

    @property
    def spent(self) -> str:
        """The seconds in words, such as `12.9 s in all, 10.1 s of them to compile kernels, once on this computer`."""
        compiled = f", {self.compiled_s:.1f} s of them to compile kernels, once on this computer"
        return f"{self.seconds:.1f} s in all{compiled if self.compiles else ''}"

    def on_start(self, _: object) -> None:
        """Note that a kernel begins to be compiled; one may need another."""
        if self._depth == 0:
            self._compile_begin_s = self._clock.now_s()
        self._depth, self.compiles = self._depth + 1, True

    def on_end(self, _: object) -> None:
        """Note that a kernel is compiled."""
        self._depth -= 1
        if self._depth == 0:
            self.compiled_s += self._clock.now_s() - self._compile_begin_s


@contextmanager
def working(doing: str, progress: Callable[[str], None], clock: Clock) -> Iterator[RunningTime]:
    """Call `progress` with `doing` and its duration, from FIRST_S on, until the end of the computation."""
    beat, ended = RunningTime(clock), Event()
    thread = Thread(target=_report, args=(doing, progress, beat, ended), name="progress", daemon=True)
    with event.install_listener("numba:compile", beat):
        thread.start()
        try:
            yield beat
        finally:
            ended.set()
            thread.join()


def _report(doing: str, progress: Callable[[str], None], beat: RunningTime, ended: Event) -> None:
    wait_s = FIRST_S
    while not ended.wait(wait_s):
        reason = f" ({COMPILING})" if beat.compiles else ""
        progress(f"{doing}: {beat.seconds:.0f} s{reason}")
        wait_s = NEXT_S - FIRST_S if wait_s == FIRST_S else LATER_S
