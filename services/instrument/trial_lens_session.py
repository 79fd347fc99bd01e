"""Interactive run with trial lenses: request a lens, measure the refraction with it, repeat, then judge the head.

For a head with a calibration in force. The run owns the head instead of the exam: one thread opens it, measures, and
closes it. If a measurement fails, the run reports the error and requests the same lens again; none can be skipped. The
lamp is on for single exposures, behind the light guard.
"""

from collections.abc import Callable
from threading import Thread

from services.instrument.calibration_run import CalibrationOutcome, RunParts
from services.instrument.trial_lens_measurement import LensCheck
from services.instrument.trial_lens_run import Measure, run_trial_lenses
from services.instrument.trial_lens_state import TrialLensRequest, TrialLensRunState, TrialLensState


class TrialLensSession:
    """Run with trial lenses on its own thread, which owns the head. Callable from any thread.

    `on_end` is called with the outcome after the head is closed. `measure` makes the measurement on the opened head.
    `trial_lens_state.TrialLensState` holds the states.
    """

    def __init__(
        self,
        parts: RunParts,
        request: TrialLensRequest,
        on_end: Callable[[CalibrationOutcome], None],
        measure: Measure = LensCheck,
    ) -> None:
        self.bench = request.bench
        self._state = TrialLensState()
        work = parts, self._state, request.bench, measure, on_end
        self._thread = Thread(target=run_trial_lenses, args=work, name="head", daemon=True)
        self._thread.start()

    def ready(self, lens: int) -> None:
        """Confirm that the lens of this number is in place, and start its measurement.

        Raises Busy if another or no lens is requested.
        """
        self._state.ready(lens)

    def stop(self) -> None:
        """Request a stop before the next frame, without waiting; the calibration in force does not change."""
        self._state.stop()

    def join(self, timeout_s: float) -> None:
        """Wait until the head is closed and `on_end` has returned, at most `timeout_s` seconds."""
        self._thread.join(timeout_s)

    def snapshot(self) -> TrialLensRunState:
        """Return the present state of the run."""
        return self._state.now
