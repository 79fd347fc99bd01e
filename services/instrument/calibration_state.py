"""State of a calibration run and the requests to it, shared by request threads and the thread `head`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from threading import Condition
from typing import Literal

from device.calibration.procedure.calibration_sequence import CalibrationTarget
from device.errors import DiffuscopeError
from services.errors import Busy
from services.instrument.calibration_request import CalibrationRequest
from services.instrument.camera_tap import CameraTap


@dataclass(frozen=True)
class RollbackRequest:
    """Request to put the archived calibration `id` in force again, without a measurement."""

    id: str


RunRequest = CalibrationRequest | RollbackRequest


@dataclass(frozen=True)
class RunState:
    """Immutable state of a run: `begin` (no stand requested yet), `asking` (waits for `stand`) or `measuring`.

    `frames`: frames taken for `stand`. `error`: last error. `found`: figures of each measured stand. `request`: what is
    measured or rolled back to, None while the run waits for a request. `fault`: fault to inject into a simulated head.
    `tap`: camera of the opened bench.
    """

    state: Literal["begin", "asking", "measuring"] = "begin"
    stand: CalibrationTarget | None = None
    frames: int = 0
    error: DiffuscopeError | None = None
    found: Mapping[CalibrationTarget, Mapping[str, float]] = field(default_factory=dict)
    request: RunRequest | None = None
    fault: str | None = None
    is_stopping: bool = False
    tap: CameraTap | None = None


class CalibrationState:
    """State of one calibration run. Thread-safe: the mutex `_lock` guards `_now`, and is never held over other work.

    begin --start--> asking (a stand) --ready--> measuring --done--> asking (the next stand) ... --> ended
    measuring --refused--> asking (the same stand); any state --stop--> ended
    """

    def __init__(self, request: RunRequest | None) -> None:
        self._lock = Condition()
        self._now = RunState(request=request)

    @property
    def now(self) -> RunState:
        """The present state."""
        with self._lock:
            return self._now

    def start(self, request: RunRequest) -> None:
        """Give a request to a run that waits for one; Busy if a calibration is under way."""
        with self._lock:
            if self._now.state != "begin" or self._now.request is not None:
                raise Busy("a calibration is under way", "Go on with it, or cancel it first.")
            self._change(replace(self._now, request=request, error=None))

    def ready(self, stand: str, fault: str | None) -> None:
        """Start the measurement of the requested stand; Busy if another or no stand is requested."""
        with self._lock:
            if self._now.state != "asking":
                raise Busy("nothing is asked for now", "Wait until the page asks for something.")
            if stand != self._now.stand:
                raise Busy(f"this step wants the {self._now.stand}, not the {stand}", "Read the page again.")
            self._change(replace(self._now, state="measuring", fault=fault, error=None, frames=0))

    def stop(self) -> None:
        """Request a stop before the next frame."""
        with self._lock:
            self._change(replace(self._now, is_stopping=True))

    # Called from the thread `head` only

    def wait(self, seen: RunState, timeout_s: float) -> None:
        """Wait until the state is another one than `seen`, at most `timeout_s` seconds of real time."""
        with self._lock:
            self._lock.wait_for(lambda: self._now is not seen, timeout_s)

    def open_tap(self, tap: CameraTap) -> None:
        """Show the camera of the opened bench to the request threads."""
        with self._lock:
            self._change(replace(self._now, tap=tap))

    def ask(self, stand: CalibrationTarget) -> None:
        """Request a stand."""
        with self._lock:
            self._change(replace(self._now, state="asking", stand=stand, frames=0))

    def count_frame(self) -> None:
        """Count one frame of the requested stand."""
        with self._lock:
            self._change(replace(self._now, frames=self._now.frames + 1))

    def show_figures(self, stand: CalibrationTarget, figures: Mapping[str, float]) -> None:
        """Show the figures of a measured stand."""
        with self._lock:
            self._change(replace(self._now, found={**self._now.found, stand: figures}))

    def show_error(self, error: DiffuscopeError) -> None:
        """Show an error; the request stays."""
        with self._lock:
            self._change(replace(self._now, error=error))

    def await_request(self, error: DiffuscopeError) -> None:
        """Show an error and drop the request, which would fail again: the run waits for a new one."""
        with self._lock:
            self._change(replace(self._now, error=error, request=None, state="begin", stand=None))

    # The caller holds the lock

    def _change(self, now: RunState) -> None:
        self._now = now
        self._lock.notify_all()
