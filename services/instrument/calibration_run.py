"""One calibration run on the thread that owns the head: open the bench, measure or roll back, close the bench."""

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.procedure.calibration_sequence import CalibrationSequence, CalibrationTarget, Operator
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import CalibrationStopped, DiffuscopeError, StoreFull
from device.head import Bench, Head
from services.instrument.calibration_request import STEPS_FOLDER, CalibrationRequest, calibration_job, write_identity
from services.instrument.calibration_state import CalibrationState, RollbackRequest, RunRequest
from services.instrument.camera_tap import CameraTap
from services.instrument.trial_lens_state import TrialLensOutcome
from services.instrument.watchdog import BEAT_S, Watchdog

log = logging.getLogger(__name__)

RETRY_S = 1.0
TAP_POLL_S = 0.2  # poll interval while no client requests sensor images
STORE_FULL_REMEDY = (
    "Free some space, or give the instrument a folder that it may write into, then measure this step again."
)


@dataclass(frozen=True)
class CalibrationOutcome:
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


class CalibrationRun:
    """Run of the procedure on an opened bench; the thread `head` alone uses it.

    `is_required`: the exam cannot own the head, because there is no valid calibration.
    """

    def __init__(self, parts: RunParts, state: CalibrationState, bench: Bench, tap: CameraTap, is_required: bool):
        self._parts, self._state, self._bench, self._tap = parts, state, bench, tap
        self._is_required = is_required
        self._stand_requested = False

    def finish(self) -> CalibrationOutcome:
        """Attempt requests until one puts a calibration in force; CalibrationStopped after a stop.

        A later attempt resumes after the finished steps. Raises the error of an attempt that requested no stand yet, if
        the exam can own the head again.
        """
        while True:
            request = self._await_request()
            self._stand_requested = False
            try:
                if isinstance(request, CalibrationRequest):
                    return CalibrationOutcome(self._measure(request), was_measured=True)
                return CalibrationOutcome(self._roll_back(request))
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                self._record_error(error)
            except OSError as error:
                self._record_error(StoreFull(f"what was measured cannot be kept: {error}", STORE_FULL_REMEDY))

    def _await_request(self) -> RunRequest:
        while (now := self._state.now).request is None:
            check_stop(self._state, self._parts.watchdog)
            self._state.wait(now, BEAT_S)
        return now.request

    def _record_error(self, error: DiffuscopeError) -> None:
        log.warning("calibration step failed: %s", error)
        if self._stand_requested:
            self._state.show_error(error)
        elif self._is_required:
            self._state.await_request(error)
        else:
            raise error  # the exam can own the head again

    def _measure(self, request: CalibrationRequest) -> StoredCalibration:
        parts = self._parts
        bench = self._bench
        operator = Operator(self._request_stand, log.info, self._state.show_figures)
        job = calibration_job(bench, parts.spec, request, log.info)
        work = parts.archive.root / STEPS_FOLDER
        procedure = CalibrationSequence(job, self._tap, operator, parts.clock, work, bench.chips.thermometer)
        kept = parts.archive.load(procedure.run(parts.archive))
        write_identity(bench, kept)
        return kept

    def _roll_back(self, request: RollbackRequest) -> StoredCalibration:
        kept = self._parts.archive.load(request.id)
        self._parts.archive.activate(request.id)
        write_identity(self._bench, kept)
        return kept

    def _request_stand(self, stand: CalibrationTarget) -> None:
        """Request a stand and stream sensor images until it is in place; CalibrationStopped after a stop.

        On a simulated head, also place the stand, and inject the requested fault.
        """
        self._bench.place_target(stand)
        self._stand_requested = True
        self._state.ask(stand)
        self._stream_until_ready()
        if (fault := self._state.now.fault) is not None:
            self._bench.inject_fault(fault)

    def _stream_until_ready(self) -> None:
        exposure_s = self._parts.spec.camera.exposure_s
        while True:
            now = self._state.now
            check_stop(self._state, self._parts.watchdog)
            if now.state == "measuring":
                return
            if not self._tap.wanted:
                self._state.wait(now, TAP_POLL_S)
                continue
            try:
                exposure_s = self._tap.take_preview(exposure_s)
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                self._state.show_error(error)
                self._state.wait(self._state.now, RETRY_S)


def check_stop(state: CalibrationState, watchdog: Watchdog) -> None:
    """Send a heartbeat; CalibrationStopped after a stop."""
    watchdog.beat()
    if state.now.is_stopping:
        raise CalibrationStopped("the technician stopped the calibration")


def run_calibration(
    parts: RunParts, state: CalibrationState, is_required: bool, on_end: Callable[[CalibrationOutcome], None]
) -> None:
    """Open the bench, run the procedure, close the bench, and call `on_end` with the outcome at every exit."""
    outcome = CalibrationOutcome(failure=DiffuscopeError("the instrument stopped unexpectedly"), is_unexpected=True)

    def before_frame() -> None:
        state.count_frame()
        check_stop(state, parts.watchdog)

    try:
        with closing(parts.open_bench()) as bench:
            parts.watchdog.ready()
            parts.watchdog.status("calibrating")
            with closing(CameraTap(bench.camera, parts.spec.camera, parts.clock, before_frame)) as tap:
                state.open_tap(tap)
                finished = CalibrationRun(parts, state, bench, tap, is_required).finish()
        outcome = finished
    except CalibrationStopped:
        outcome = CalibrationOutcome()
    except DiffuscopeError as error:  # from opening or closing the bench, or an attempt that the exam can follow
        outcome = CalibrationOutcome(failure=error)
    finally:
        on_end(outcome)
