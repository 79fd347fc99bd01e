"""Lines of progress while a command computes: what it does and for how long, and whether kernels are compiled."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from threading import Event, Thread
from typing import ParamSpec, TypeVar

import typer

from device.clock import Clock, SystemClock

Given = ParamSpec("Given")
Result = TypeVar("Result")

FIRST_S, NEXT_S, LATER_S = 1.0, 3.0, 10.0  # after the start; then every LATER_S
COMPILING = "compiling kernels, which this computer then keeps"


class RunningTime:
    """Durations of a computation in seconds: of all of it, and of the compilation of kernels within it."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._begin_s = clock.now_s()
        self._depth = 0
        self._compile_begin_s = 0.0
        self.compiles = False
        self.compiled_s = 0.0

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return self._clock.now_s() - self._begin_s

    @property
    def spent(self) -> str:
        """The seconds in words, such as `12.9 s in all, 10.1 s of them to compile kernels, once on this computer`."""
        compiled = f", {self.compiled_s:.1f} s of them to compile kernels, once on this computer"
        return f"{self.seconds:.1f} s in all{compiled if self.compiles else ''}"

    def begin_kernel(self) -> None:
        """Note that a kernel begins to be compiled; one may need another."""
        if self._depth == 0:
            self._compile_begin_s = self._clock.now_s()
        self._depth = self._depth + 1
        self.compiles = True

    def end_kernel(self) -> None:
        """Note that a kernel is compiled."""
        self._depth -= 1
        if self._depth == 0:
            self.compiled_s += self._clock.now_s() - self._compile_begin_s


def announced(doing: str) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Return a decorator of a command that asks nothing: `doing` and its duration go to stderr while it runs."""

    def decorate(command: Callable[Given, Result]) -> Callable[Given, Result]:
        @wraps(command)
        def run(*args: Given.args, **kwargs: Given.kwargs) -> Result:
            with announcing(doing):
                return command(*args, **kwargs)

        vars(run)["announced"] = doing
        return run

    return decorate


def say(line: str) -> None:
    """Print a line to stderr."""
    typer.echo(line, err=True)


@contextmanager
def working(doing: str, progress: Callable[[str], None] = say, clock: Clock | None = None) -> Iterator[RunningTime]:
    """Call `progress` with `doing` and its duration, from FIRST_S on, until the end of a computation with kernels."""
    from numba.core import event  # not for commands without kernels: it takes a third of a second

    class Kernels(event.Listener):
        def on_start(self, _: object) -> None:
            beat.begin_kernel()

        def on_end(self, _: object) -> None:
            beat.end_kernel()

    with announcing(doing, progress, clock) as beat, event.install_listener("numba:compile", Kernels()):
        yield beat


@contextmanager
def announcing(doing: str, progress: Callable[[str], None] = say, clock: Clock | None = None) -> Iterator[RunningTime]:
    """Call `progress` with `doing` and its duration, from FIRST_S on, until the end; kernels are not looked at."""
    beat = RunningTime(clock or SystemClock())
    ended = Event()
    thread = Thread(target=_report, args=(doing, progress, beat, ended), name="progress", daemon=True)
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
