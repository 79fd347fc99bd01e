"""Steps of a guided run with trial lenses: measure the refraction with each lens, then judge the head.

For a head with a calibration in force. The lamp is on for single exposures, behind the light guard.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.trial_lenses import LensReading, TrialLensFit
from device.errors import CalibrationStopped, DiffuscopeError
from device.head import Head
from device.optics.trial_lens import TrialLens
from services.errors import Busy
from services.instrument.camera_tap import CameraTap
from services.instrument.guided_run import (
    GuidedRun,
    GuidedSession,
    RunErrors,
    RunOutcome,
    RunParts,
    run_guided,
)
from services.instrument.trial_lens_measurement import LensBench, LensCheck, TrialLensOutcome

log = logging.getLogger(__name__)

Measure = Callable[[Head, Archive, LensBench], LensCheck]

ERRORS = RunErrors[int](
    lambda: Busy("no lens is asked for now", "Wait until the page asks for one."),
    lambda asked, given: Busy(f"lens {(asked or 0) + 1} is asked for, not lens {given + 1}", "Read the page again."),
    lambda: CalibrationStopped("the technician stopped the check with trial lenses"),
)


@dataclass(frozen=True)
class TrialLensRequest:
    """Request to measure the head with the lenses of a bench."""

    bench: LensBench


LensRun = GuidedRun[int, LensReading, TrialLensRequest]  # a step is the number of a lens in the bench, from 0


class TrialLensSession(GuidedSession[int, LensReading, TrialLensRequest]):
    """Run with trial lenses; `measure` makes the measurement on the opened head.

    `on_end` is called with the outcome after the head is closed.
    """

    def __init__(
        self,
        parts: RunParts,
        request: TrialLensRequest,
        on_end: Callable[[RunOutcome], None],
        measure: Measure = LensCheck,
    ) -> None:
        self.bench = request.bench
        run = LensRun(parts, request, ERRORS)

        def finish(head: Head, tap: CameraTap) -> RunOutcome:
            check = measure(replace(head, camera=tap), parts.archive, request.bench)
            return TrialLensSteps(run, request.bench, check, tap).finish()

        super().__init__(run, lambda: run_guided(run, parts.open_head, finish, on_end, "measuring trial lenses"))

    def ready(self, lens: int) -> None:
        """Confirm that the lens of this number is in place, and start its measurement.

        Raises Busy if another or no lens is requested.
        """
        self.run.ready(lens)


class TrialLensSteps:
    """Steps on an opened head; the thread `head` alone uses them."""

    def __init__(self, run: LensRun, bench: LensBench, check: LensCheck, tap: CameraTap) -> None:
        self._run = run
        self._bench = bench
        self._check = check
        self._tap = tap

    def finish(self) -> RunOutcome:
        """Request each lens and measure it, then judge the head; CalibrationStopped after a stop.

        Within its limits the calibration with the offset is then in force; else the outcome has the refusal.
        """
        readings = tuple(self._read(number, lens) for number, lens in enumerate(self._bench.lenses))
        self._run.check_stop()
        fit = None
        try:
            fit = self._check.fit(readings)
            stored = self._check.keep(fit)
        except DiffuscopeError as error:
            log.warning("trial lenses: the calibration stays as it was: %s", error)
            return RunOutcome(failure=error, lenses=self._outcome(readings, fit, None, error))
        log.info("trial lenses: offset %+.3f dpt, slope %.3f", fit.offset.m_dpt, fit.slope)
        return RunOutcome(stored, lenses=self._outcome(readings, fit, stored))

    def _read(self, number: int, lens: TrialLens) -> LensReading:
        """Request a lens until its measurement succeeds."""
        self._check.present(lens)
        while True:
            self._run.ask(number, self._tap)
            try:
                reading = self._check.read(lens)
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                log.warning("measurement with the trial lens %s failed: %s", lens.label, error)
                self._run.show_error(error)
            else:
                self._run.show_found(number, reading)
                return reading

    def _outcome(
        self,
        readings: tuple[LensReading, ...],
        fit: TrialLensFit | None,
        stored: StoredCalibration | None,
        failure: DiffuscopeError | None = None,
    ) -> TrialLensOutcome:
        return TrialLensOutcome(self._bench, readings, self._run.parts.clock.wall(), fit, stored, failure)
