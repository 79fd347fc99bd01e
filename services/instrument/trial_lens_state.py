"""State of a run with trial lenses, shared by request threads and the thread `head`; its request and its outcome."""

from dataclasses import dataclass, replace
from datetime import datetime
from threading import Condition
from typing import Literal

from device.calibration.archive import StoredCalibration
from device.calibration.trial_lenses import LensReading, TrialLensFit
from device.errors import DiffuscopeError
from services.errors import Busy
from services.instrument.trial_lens_measurement import LensBench


@dataclass(frozen=True)
class TrialLensRequest:
    """Request to measure the head with the lenses of a bench."""

    bench: LensBench


@dataclass(frozen=True)
class TrialLensOutcome:
    """Readings of a finished run; `stored` is the calibration with the offset, now in force.

    `fit` is None if the readings determine nothing, `stored` is None if the head was refused or nothing could be
    stored; then the calibration in force stays, and `failure` has the reason.
    """

    bench: LensBench
    readings: tuple[LensReading, ...]
    ended_at: datetime
    fit: TrialLensFit | None = None
    stored: StoredCalibration | None = None
    failure: DiffuscopeError | None = None


@dataclass(frozen=True)
class TrialLensRunState:
    """Immutable state of a run: `begin` (opens the head), `asking` (waits for a lens) or `measuring`.

    `lens`: number of the requested lens in the bench, from 0. `readings`: of the lenses before it, in order. `error`:
    why the last measurement failed.
    """

    state: Literal["begin", "asking", "measuring"] = "begin"
    lens: int = 0
    readings: tuple[LensReading, ...] = ()
    error: DiffuscopeError | None = None
    is_stopping: bool = False


class TrialLensState:
    """State of one run. Thread-safe: the mutex `_lock` guards `_now`, and is never held over other work.

    begin --> asking (the first lens) --ready--> measuring --done--> asking (the next lens) ... --> ended
    measuring --failed--> asking (the same lens); any state --stop--> ended
    """

    def __init__(self) -> None:
        self._lock = Condition()
        self._now = TrialLensRunState()

    @property
    def now(self) -> TrialLensRunState:
        """The present state."""
        with self._lock:
            return self._now

    def ready(self, lens: int) -> None:
        """Start the measurement of the requested lens; Busy if another or no lens is requested."""
        with self._lock:
            if self._now.state != "asking":
                raise Busy("no lens is asked for now", "Wait until the page asks for one.")
            if lens != self._now.lens:
                raise Busy(f"lens {self._now.lens + 1} is asked for, not lens {lens + 1}", "Read the page again.")
            self._change(replace(self._now, state="measuring", error=None))

    def stop(self) -> None:
        """Request a stop before the next frame."""
        with self._lock:
            self._change(replace(self._now, is_stopping=True))

    # Called from the thread `head` only

    def wait(self, seen: TrialLensRunState, timeout_s: float) -> None:
        """Wait until the state is another one than `seen`, at most `timeout_s` seconds of real time."""
        with self._lock:
            self._lock.wait_for(lambda: self._now is not seen, timeout_s)

    def ask(self, lens: int) -> None:
        """Request a lens; an error of its last measurement stays."""
        with self._lock:
            self._change(replace(self._now, state="asking", lens=lens))

    def show_reading(self, reading: LensReading) -> None:
        """Show the reading of the requested lens."""
        with self._lock:
            self._change(replace(self._now, readings=(*self._now.readings, reading)))

    def show_error(self, error: DiffuscopeError) -> None:
        """Show why the measurement failed."""
        with self._lock:
            self._change(replace(self._now, error=error))

    # The caller holds the lock

    def _change(self, now: TrialLensRunState) -> None:
        self._now = now
        self._lock.notify_all()
