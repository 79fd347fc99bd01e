"""Steps of a guided calibration: a target before the head, its measurement, the next one; or a rollback.

Stand: calibration target in front of the head (cap, screen, point source). Bench: head opened without a calibration.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

from device.calibration.archive import StoredCalibration
from device.calibration.procedure.calibration_sequence import (
    BRACKETS,
    DARK_FRAMES,
    FLAT_FRAMES,
    FLAT_LEVELS,
    CalibrationSequence,
    CalibrationTarget,
    Operator,
)
from device.errors import CalibrationStopped, DiffuscopeError, SettingError, StoreFull
from device.head import Bench, fault_names
from services.errors import Busy
from services.instrument.calibration_request import STEPS_FOLDER, CalibrationRequest, calibration_job, write_identity
from services.instrument.camera_tap import CameraTap
from services.instrument.guided_run import (
    GuidedRun,
    GuidedSession,
    RunErrors,
    RunOutcome,
    RunParts,
    RunState,
    run_guided,
)
from services.instrument.watchdog import BEAT_S

log = logging.getLogger(__name__)

STANDS: tuple[CalibrationTarget, ...] = ("cap", "screen", "point")
SEARCH_FRAMES = 6  # approximate number of frames of the exposure search
EXPECTED_FRAMES: Mapping[CalibrationTarget, int] = {
    "cap": 3 * DARK_FRAMES,
    "screen": SEARCH_FRAMES + len(FLAT_LEVELS) * FLAT_FRAMES + 2,
    "point": SEARCH_FRAMES + sum(n for _, n in BRACKETS),
}
STORE_FULL_REMEDY = (
    "Free some space, or give the instrument a folder that it may write into, then measure this step again."
)
ERRORS = RunErrors[CalibrationTarget](
    lambda: Busy("nothing is asked for now", "Wait until the page asks for something."),
    lambda asked, given: Busy(f"this step wants the {asked}, not the {given}", "Read the page again."),
    lambda: CalibrationStopped("the technician stopped the calibration"),
)


@dataclass(frozen=True)
class RollbackRequest:
    """Request to put the archived calibration `id` in force again, without a measurement."""

    id: str


RunRequest = CalibrationRequest | RollbackRequest
Figures = Mapping[str, float]  # of a measured stand
TargetRun = GuidedRun[CalibrationTarget, Figures, RunRequest]  # a step is a stand
TargetState = RunState[CalibrationTarget, Figures, RunRequest]


class CalibrationSession(GuidedSession[CalibrationTarget, Figures, RunRequest]):
    """Calibration run; without a `request` (no valid calibration) it waits for `start`.

    `on_end` is called with the outcome after the bench is closed. Finished steps stay on disk for the next run.
    """

    def __init__(self, parts: RunParts, request: RunRequest | None, on_end: Callable[[RunOutcome], None]) -> None:
        run = TargetRun(parts, request, ERRORS)

        def finish(bench: Bench, tap: CameraTap) -> RunOutcome:
            return CalibrationSteps(run, bench, tap, is_required=request is None).finish()

        super().__init__(run, lambda: run_guided(run, parts.open_bench, finish, on_end, "calibrating"))

    def start(self, request: RunRequest) -> None:
        """Start the requested measurement or rollback in a run that waits for a request; Busy if one is under way."""
        self.run.start(request)

    def ready(self, stand: str, fault: str | None = None) -> None:
        """Confirm that the stand is in place and start its measurement.

        `fault`: name of a fault to inject into a simulated head. Raises Busy if another or no stand is requested,
        SettingError for a fault that the head cannot simulate.
        """
        is_simulated = self.run.parts.spec.camera.backend == "sim"
        if fault is not None and (not is_simulated or fault not in fault_names()):
            raise SettingError(f"{fault!r} cannot go wrong on this head", "Leave it out.")
        self.run.ready(cast(CalibrationTarget, stand), fault)  # another name is not the requested one


def measured_share(now: TargetState) -> float | None:
    """Return the measured share of the expected frames of the requested stand, 0 to 1; None if it is unknown."""
    expected = None if now.step is None else EXPECTED_FRAMES.get(now.step)
    return None if expected is None else min(now.frames / expected, 1.0)


class CalibrationSteps:
    """Steps on an opened bench; the thread `head` alone uses them.

    `is_required`: the exam cannot own the head, because there is no valid calibration.
    """

    def __init__(self, run: TargetRun, bench: Bench, tap: CameraTap, is_required: bool) -> None:
        self._run = run
        self._bench = bench
        self._tap = tap
        self._is_required = is_required
        self._stand_requested = False

    def finish(self) -> RunOutcome:
        """Attempt requests until one puts a calibration in force; CalibrationStopped after a stop.

        A later attempt resumes after the finished steps. Raises the error of an attempt that requested no stand yet, if
        the exam can own the head again.
        """
        while True:
            request = self._await_request()
            self._stand_requested = False
            try:
                if isinstance(request, CalibrationRequest):
                    return RunOutcome(self._measure(request), was_measured=True)
                return RunOutcome(self._roll_back(request))
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                self._record_error(error)
            except OSError as error:
                self._record_error(StoreFull(f"what was measured cannot be saved: {error}", STORE_FULL_REMEDY))

    def _await_request(self) -> RunRequest:
        while (now := self._run.now).request is None:
            self._run.check_stop()
            self._run.wait(now, BEAT_S)
        return now.request

    def _record_error(self, error: DiffuscopeError) -> None:
        log.warning("calibration step failed: %s", error)
        if self._stand_requested:
            self._run.show_error(error)
        elif self._is_required:
            self._run.await_request(error)
        else:
            raise error  # the exam can own the head again

    def _measure(self, request: CalibrationRequest) -> StoredCalibration:
        parts = self._run.parts
        bench = self._bench
        operator = Operator(self._request_stand, log.info, self._run.show_found)
        job = calibration_job(bench, parts.spec, request, log.info)
        work = parts.archive.root / STEPS_FOLDER
        procedure = CalibrationSequence(job, self._tap, operator, parts.clock, work, bench.chips.thermometer)
        kept = parts.archive.load(procedure.run(parts.archive))
        write_identity(bench, kept)
        return kept

    def _roll_back(self, request: RollbackRequest) -> StoredCalibration:
        archive = self._run.parts.archive
        kept = archive.load(request.id)
        archive.activate(request.id)
        write_identity(self._bench, kept)
        return kept

    def _request_stand(self, stand: CalibrationTarget) -> None:
        """Request a stand and wait until it is in place; CalibrationStopped after a stop.

        On a simulated head, also place the stand, and inject the requested fault.
        """
        self._bench.place_target(stand)
        self._stand_requested = True
        self._run.ask(stand, self._tap)
        if (fault := self._run.now.fault) is not None:
            self._bench.inject_fault(fault)
