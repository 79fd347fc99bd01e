"""Guided run: request a step from the operator, show the sensor image, measure, repeat. The run owns the head.

It owns the head instead of the exam: one thread opens it, makes the steps and closes it. If a step fails, the run
reports the error and requests the same step again; no step can be skipped. `calibration_run` has the steps of a
calibration (targets before the head), `trial_lens_run` those of a check with trial lenses.
"""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from threading import Condition, Thread
from typing import Generic, Literal, TypeVar

from device.calibration.archive import Archive, StoredCalibration
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import CalibrationStopped, DiffuscopeError
from device.head import Bench, Head
from services.errors import Busy
from services.instrument.camera_tap import CameraTap, TapPicture
from services.instrument.trial_lens_measurement import TrialLensOutcome
from services.instrument.watchdog import Watchdog

RETRY_S = 1.0
TAP_POLL_S = 0.2  # poll interval while no client requests sensor images

Step = TypeVar("Step")
Found = TypeVar("Found")
Request = TypeVar("Request")
Opened = TypeVar("Opened", Bench, Head)


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of a run: the calibration put in force, whether this run measured it, and the error that ended the run.

    `failure` is None after success or a stop; `is_unexpected`: it was no DiffuscopeError. `lenses`: readings of a run
    with trial lenses, None of any other run.
    """

    result: StoredCalibration | None = None
    was_measured: bool = False
    failure: DiffuscopeError | None = None
    is_unexpected: bool = False
    lenses: TrialLensOutcome | None = None


@dataclass(frozen=True)
class RunParts:
    """Parts of a run; `open_bench` opens the head without a calibration, `open_head` with the one in force."""

    spec: InstrumentSpec
    archive: Archive
    clock: Clock
    watchdog: Watchdog
    open_bench: Callable[[], Bench]
    open_head: Callable[[], Head]


@dataclass(frozen=True)
class RunState(Generic[Step, Found, Request]):
    """Immutable state of a run: `begin` (no step requested yet), `asking` (waits for `step`) or `measuring`.

    `request`: what the run is to make, None while it waits for a request. `found`: result of each measured step, in
    their order. `frames`: frames taken for `step`. `error`: last error. `fault`: fault to inject into a simulated head.
    `tap`: camera of the opened head.
    """

    request: Request | None
    state: Literal["begin", "asking", "measuring"] = "begin"
    step: Step | None = None
    found: Mapping[Step, Found] = field(default_factory=dict)
    frames: int = 0
    error: DiffuscopeError | None = None
    fault: str | None = None
    is_stopping: bool = False
    tap: CameraTap | None = None


@dataclass(frozen=True)
class RunErrors(Generic[Step]):
    """Errors of a run: no step is requested now; another one is requested than the given one; a stop was."""

    no_step: Callable[[], Busy]
    other_step: Callable[[Step | None, Step], Busy]
    stopped: Callable[[], CalibrationStopped]


class GuidedRun(Generic[Step, Found, Request]):
    """State of one run, and what the thread `head` does between its steps.

    Thread-safe: the mutex `_lock` guards `_now`, and is never held over other work.

    begin --start--> asking (a step) --ready--> measuring --done--> asking (the next step) ... --> ended
    measuring --failed--> asking (the same step); any state --stop--> ended
    """

    def __init__(self, parts: RunParts, request: Request | None, errors: RunErrors[Step]) -> None:
        self.parts = parts
        self._errors = errors
        self._lock = Condition()
        self._now: RunState[Step, Found, Request] = RunState(request)

    @property
    def now(self) -> RunState[Step, Found, Request]:
        """The present state."""
        with self._lock:
            return self._now

    def start(self, request: Request) -> None:
        """Give a request to a run that waits for one; Busy if it has one."""
        with self._lock:
            if self._now.state != "begin" or self._now.request is not None:
                raise Busy("a calibration is under way", "Go on with it, or cancel it first.")
            self._change(replace(self._now, request=request, error=None))

    def ready(self, step: Step, fault: str | None = None) -> None:
        """Start the measurement of the requested step; Busy if another or no step is requested."""
        with self._lock:
            if self._now.state != "asking":
                raise self._errors.no_step()
            if step != self._now.step:
                raise self._errors.other_step(self._now.step, step)
            self._change(replace(self._now, state="measuring", fault=fault, error=None, frames=0))

    def stop(self) -> None:
        """Request a stop before the next frame."""
        with self._lock:
            self._change(replace(self._now, is_stopping=True))

    # Called from the thread `head` only

    def wait(self, seen: RunState[Step, Found, Request], timeout_s: float) -> None:
        """Wait until the state is another one than `seen`, at most `timeout_s` seconds of real time."""
        with self._lock:
            self._lock.wait_for(lambda: self._now is not seen, timeout_s)

    def check_stop(self) -> None:
        """Send a heartbeat; CalibrationStopped after a stop."""
        self.parts.watchdog.beat()
        if self.now.is_stopping:
            raise self._errors.stopped()

    def open_tap(self, tap: CameraTap) -> None:
        """Show the camera of the opened head to the request threads."""
        with self._lock:
            self._change(replace(self._now, tap=tap))

    def count_frame(self) -> None:
        """Count one frame of the requested step, before it is taken; CalibrationStopped after a stop."""
        with self._lock:
            self._change(replace(self._now, frames=self._now.frames + 1))
        self.check_stop()

    def ask(self, step: Step, tap: CameraTap) -> None:
        """Request a step, and stream sensor images until it is ready; CalibrationStopped after a stop.

        An error of its last measurement stays.
        """
        exposure_s = self.parts.spec.camera.exposure_s
        with self._lock:
            self._change(replace(self._now, state="asking", step=step, frames=0))
        while True:
            now = self.now
            self.check_stop()
            if now.state == "measuring":
                return
            if not tap.wanted:
                self.wait(now, TAP_POLL_S)
                continue
            try:
                exposure_s = tap.take_preview(exposure_s)
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                self.show_error(error)
                self.wait(self.now, RETRY_S)

    def show_found(self, step: Step, found: Found) -> None:
        """Show the result of a measured step."""
        with self._lock:
            self._change(replace(self._now, found={**self._now.found, step: found}))

    def show_error(self, error: DiffuscopeError) -> None:
        """Show an error; the request stays."""
        with self._lock:
            self._change(replace(self._now, error=error))

    def await_request(self, error: DiffuscopeError) -> None:
        """Show an error and drop the request, which would fail again: the run waits for a new one."""
        with self._lock:
            self._change(replace(self._now, error=error, request=None, state="begin", step=None))

    # The caller holds the lock

    def _change(self, now: RunState[Step, Found, Request]) -> None:
        self._now = now
        self._lock.notify_all()


class GuidedSession(Generic[Step, Found, Request]):
    """Run on its own thread, which owns the head; `work` makes it. Callable from any thread."""

    def __init__(self, run: GuidedRun[Step, Found, Request], work: Callable[[], None]) -> None:
        self.run = run
        self._thread = Thread(target=work, name="head", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Request a stop before the next frame, without waiting; the calibration in force does not change."""
        self.run.stop()

    def join(self, timeout_s: float) -> None:
        """Wait until the head is closed and the end of the run reported, at most `timeout_s` seconds."""
        self._thread.join(timeout_s)

    def next_picture(self, after: int) -> TapPicture | None:
        """Return the next sensor image with a number above `after`; None without one within 2 s or an open head."""
        tap = self.run.now.tap
        return tap.next_picture(after) if tap is not None else None


def run_guided(
    run: GuidedRun[Step, Found, Request],
    open_head: Callable[[], Opened],
    finish: Callable[[Opened, CameraTap], RunOutcome],
    on_end: Callable[[RunOutcome], None],
    status: str,
) -> None:
    """Open the head, make the steps, close it, and call `on_end` with the outcome at every exit.

    `finish` makes all steps on the opened head, whose frames it takes through the tap. `status`: for systemd.
    """
    parts = run.parts
    outcome = RunOutcome(failure=DiffuscopeError("the instrument stopped unexpectedly"), is_unexpected=True)
    try:
        with closing(open_head()) as head:
            parts.watchdog.ready()
            parts.watchdog.status(status)
            with closing(CameraTap(head.camera, parts.spec.camera, parts.clock, run.count_frame)) as tap:
                run.open_tap(tap)
                finished = finish(head, tap)
        outcome = finished
    except CalibrationStopped:
        outcome = RunOutcome()
    except DiffuscopeError as error:  # from opening or closing the head, or an attempt that the exam can follow
        outcome = RunOutcome(failure=error)
    finally:
        on_end(outcome)
