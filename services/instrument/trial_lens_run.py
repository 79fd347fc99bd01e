"""One run with trial lenses on the thread that owns the head: open the head, measure each lens, judge, close."""

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.trial_lenses import LensReading, TrialLensFit
from device.errors import CalibrationStopped, DiffuscopeError
from device.head import Head
from device.optics.trial_lens import TrialLens
from services.instrument.calibration_run import CalibrationOutcome, RunParts
from services.instrument.camera_tap import CameraTap
from services.instrument.trial_lens_measurement import LensBench, LensCheck
from services.instrument.trial_lens_state import TrialLensOutcome, TrialLensState
from services.instrument.watchdog import BEAT_S, Watchdog

log = logging.getLogger(__name__)

Measure = Callable[[Head, Archive, LensBench], LensCheck]


class TrialLensRun:
    """Run on an opened head; the thread `head` alone uses it."""

    def __init__(self, parts: RunParts, state: TrialLensState, bench: LensBench, check: LensCheck) -> None:
        self._parts, self._state, self._bench, self._check = parts, state, bench, check

    def finish(self) -> CalibrationOutcome:
        """Request each lens and measure it, then judge the head; CalibrationStopped after a stop.

        Within its limits the calibration with the offset is then in force; else the outcome has the refusal.
        """
        readings = tuple(self._read(number, lens) for number, lens in enumerate(self._bench.lenses))
        check_stop(self._state, self._parts.watchdog)
        fit = None
        try:
            fit = self._check.fit(readings)
            stored = self._check.keep(fit)
        except DiffuscopeError as error:
            return self._refused(readings, fit, error)
        log.info("trial lenses: offset %+.3f dpt, slope %.3f", fit.offset.m_dpt, fit.slope)
        return CalibrationOutcome(stored, lenses=self._outcome(readings, fit, stored))

    def _read(self, number: int, lens: TrialLens) -> LensReading:
        """Request a lens until its measurement succeeds."""
        self._check.present(lens)
        while True:
            self._state.ask(number)
            self._wait_until_ready()
            try:
                reading = self._check.read(lens)
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                log.warning("measurement with the trial lens %s failed: %s", lens.label, error)
                self._state.show_error(error)
            else:
                self._state.show_reading(reading)
                return reading

    def _wait_until_ready(self) -> None:
        while (now := self._state.now).state != "measuring":
            check_stop(self._state, self._parts.watchdog)
            self._state.wait(now, BEAT_S)

    def _refused(
        self, readings: tuple[LensReading, ...], fit: TrialLensFit | None, failure: DiffuscopeError
    ) -> CalibrationOutcome:
        log.warning("trial lenses: the calibration stays as it was: %s", failure)
        return CalibrationOutcome(failure=failure, lenses=self._outcome(readings, fit, None, failure))

    def _outcome(
        self,
        readings: tuple[LensReading, ...],
        fit: TrialLensFit | None,
        stored: StoredCalibration | None,
        failure: DiffuscopeError | None = None,
    ) -> TrialLensOutcome:
        return TrialLensOutcome(self._bench, readings, self._parts.clock.wall(), fit, stored, failure)


def check_stop(state: TrialLensState, watchdog: Watchdog) -> None:
    """Send a heartbeat; CalibrationStopped after a stop."""
    watchdog.beat()
    if state.now.is_stopping:
        raise CalibrationStopped("the technician stopped the check with trial lenses")


def run_trial_lenses(
    parts: RunParts,
    state: TrialLensState,
    bench: LensBench,
    measure: Measure,
    on_end: Callable[[CalibrationOutcome], None],
) -> None:
    """Open the head, measure it with each lens, close it, and call `on_end` with the outcome at every exit."""
    outcome = CalibrationOutcome(failure=DiffuscopeError("the instrument stopped unexpectedly"), is_unexpected=True)
    try:
        with closing(parts.open_head()) as head:
            parts.watchdog.ready()
            parts.watchdog.status("measuring trial lenses")
            with closing(_stoppable(head, parts, state)) as tap:
                check = measure(replace(head, camera=tap), parts.archive, bench)
                finished = TrialLensRun(parts, state, bench, check).finish()
        outcome = finished
    except CalibrationStopped:
        outcome = CalibrationOutcome()
    except DiffuscopeError as error:  # from opening or closing the head
        outcome = CalibrationOutcome(failure=error)
    finally:
        on_end(outcome)


def _stoppable(head: Head, parts: RunParts, state: TrialLensState) -> CameraTap:
    """Return the camera of the head, which takes no frame after a stop."""
    return CameraTap(head.camera, parts.spec.camera, parts.clock, lambda: check_stop(state, parts.watchdog))
