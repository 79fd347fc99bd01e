"""Interactive calibration run: request a stand, show the sensor image, measure, repeat.

Stand: calibration target in front of the head (cap, screen, point source). Bench: head opened without a calibration.
The run owns the head instead of the exam: one thread opens the bench, runs the procedure and closes the bench.
If a step refuses its frames, the run reports the error and requests the same stand again; no step can be skipped.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Thread

from device.calibration.procedure.calibration_sequence import (
    BRACKETS,
    DARK_FRAMES,
    FLAT_FRAMES,
    FLAT_LEVELS,
    CalibrationTarget,
)
from device.errors import DiffuscopeError, SettingError
from device.head import fault_names
from services.instrument.calibration_run import CalibrationOutcome, RunParts, run_calibration
from services.instrument.calibration_state import CalibrationState, RunRequest
from services.instrument.camera_tap import TapPicture

STANDS: tuple[CalibrationTarget, ...] = ("cap", "screen", "point")
SEARCH_FRAMES = 6  # approximate number of frames of the exposure search
EXPECTED_FRAMES = {
    "cap": 3 * DARK_FRAMES,
    "screen": SEARCH_FRAMES + len(FLAT_LEVELS) * FLAT_FRAMES + 2,
    "point": SEARCH_FRAMES + sum(n for _, n in BRACKETS),
}


@dataclass(frozen=True)
class SessionState:
    """State of a calibration run at one moment: `state`, requested `stand`, last error, figures of each measured stand.

    `progress`: measured share of the expected frames of the stand, 0 to 1; None if unknown.
    """

    state: str
    stand: CalibrationTarget | None = None
    found: Mapping[CalibrationTarget, Mapping[str, float]] = field(default_factory=dict)
    error: DiffuscopeError | None = None
    progress: float | None = None


class CalibrationSession:
    """Calibration run on its own thread, which owns the head. Callable from any thread.

    Without a `request` (no valid calibration) the run waits for `start`. `on_end` is called with the outcome after the
    bench is closed. `calibration_state.CalibrationState` holds the states.
    """

    def __init__(
        self, parts: RunParts, request: RunRequest | None, on_end: Callable[[CalibrationOutcome], None]
    ) -> None:
        self._spec = parts.spec
        self._state = CalibrationState(request)
        work = parts, self._state, request is None, on_end
        self._thread = Thread(target=run_calibration, args=work, name="head", daemon=True)
        self._thread.start()

    def start(self, request: RunRequest) -> None:
        """Start the requested measurement or rollback in a run that waits for a request; Busy if one is under way."""
        self._state.start(request)

    def ready(self, stand: str, fault: str | None = None) -> None:
        """Confirm that the stand is in place and start its measurement.

        `fault`: name of a fault to inject into a simulated head. Raises Busy if another or no stand is requested,
        SettingError for a fault that the head cannot simulate.
        """
        if fault is not None and (self._spec.camera.backend != "sim" or fault not in fault_names()):
            raise SettingError(f"{fault!r} cannot go wrong on this head", "Leave it out.")
        self._state.ready(stand, fault)

    def stop(self) -> None:
        """Request a stop before the next frame, without waiting; finished steps stay on disk for the next run."""
        self._state.stop()

    def join(self, timeout_s: float) -> None:
        """Wait until the bench is closed and `on_end` has returned, at most `timeout_s` seconds."""
        self._thread.join(timeout_s)

    def next_picture(self, after: int) -> TapPicture | None:
        """Return the next sensor image with a number above `after`; None without one within 2 s or without a bench."""
        tap = self._state.now.tap
        return tap.next_picture(after) if tap is not None else None

    def snapshot(self) -> SessionState:
        """Return the present state of the run."""
        now = self._state.now
        expected = EXPECTED_FRAMES.get(now.stand or "")
        progress = min(now.frames / expected, 1.0) if expected else None
        return SessionState(now.state, now.stand, now.found, now.error, progress)
