"""Arbiter of the head: either the exam or a calibration run owns it, never both at once.

A run with trial lenses is a calibration run of a head whose calibration is valid.
"""

import asyncio
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Condition
from typing import Literal

from device.calibration.archive import Archive
from device.calibration.monitoring.finding import Finding
from device.clock import Clock
from device.config.head_file import CalibrationTable, InstrumentSpec
from device.errors import CalibrationError, DiffuscopeError, HeadMismatch
from device.head import Bench, Head, open_head, refuse_recording
from device.light_safety.dose_ledger import MemoryLedger
from services.errors import Busy
from services.instrument.calibration_run import CalibrationSession, RollbackRequest, RunRequest
from services.instrument.capture import NO_VISIT, LiveRequest, Preview
from services.instrument.events import EventBus
from services.instrument.exam import ExamService
from services.instrument.exam_state import WireState
from services.instrument.guided_run import RunOutcome, RunParts
from services.instrument.trial_lens_measurement import TrialLensOutcome
from services.instrument.trial_lens_run import TrialLensRequest, TrialLensSession
from services.instrument.watchdog import Watchdog
from services.records.capture_store import CaptureStore

log = logging.getLogger(__name__)

CALIBRATION_STOP_TIMEOUT_S = 30.0
AIMING_S = 5.0  # after the last request for a live picture; one request may take 2 s
NO_PREVIEW_S = 1.0  # delay that limits the request rate of a polling page


@dataclass(frozen=True)
class AppContext:
    """Objects shared by exam and calibration run; `on_failure` stops the process when neither can own the head.

    `archive` holds the calibrations, `store` the captures.
    """

    spec: InstrumentSpec
    archive: Archive
    store: CaptureStore
    event_bus: EventBus
    clock: Clock
    watchdog: Watchdog
    on_failure: Callable[[], None]


@dataclass(frozen=True)
class HeadOwner:
    """Owner of the head at one moment; immutable.

    The exam or the calibration run owns the head; during a transfer neither does. `calibration_error`: why the exam
    cannot own it. `calibration_failure`: error that ended the last calibration run; `last_made_id`: calibration id
    of the last finished one; `last_lenses`: readings of the last run, if it was one with trial lenses. `failure`: error
    that ended the process.
    """

    exam: ExamService | None = None
    session: CalibrationSession | TrialLensSession | None = None
    calibration_error: DiffuscopeError | None = None
    calibration_failure: DiffuscopeError | None = None
    last_made_id: str | None = None
    last_lenses: TrialLensOutcome | None = None
    failure: DiffuscopeError | None = None
    is_closing: bool = False
    is_in_transfer: bool = False

    @property
    def problem(self) -> DiffuscopeError | None:
        """The error that prevents captures now (Busy while a valid calibration is repeated); None if there is none."""
        return self.absence if self.exam is None else self.exam.problem

    @property
    def absence(self) -> DiffuscopeError:
        """The reason why the exam does not own the head: no valid calibration, or Busy during a calibration."""
        return self.calibration_error or Busy(
            "the technician is calibrating the camera", "Wait until the calibration is done."
        )

    @property
    def state(self) -> WireState:
        """The state of the exam; `busy` while the exam does not own the head."""
        return self.exam.state if self.exam is not None else "busy"

    @property
    def idle_state(self) -> Literal["starting", "idle"]:
        """The calibration state without a run: `starting` until the exam can release the head, then `idle`."""
        return "idle" if self.exam is not None and self.exam.ready.is_set() else "starting"


class HeadTransfer:
    """Transfer of the head between exam and calibration run, one at a time.

    The mutex `_lock` guards `_owner`. It is never held while a thread is joined, the head is opened or a callback runs;
    meanwhile `is_in_transfer` keeps other transfers out.
    """

    def __init__(
        self, context: AppContext, open_exam: Callable[[], ExamService], open_bench: Callable[[], Bench]
    ) -> None:
        self._context, self._open_exam = context, open_exam
        self._run_parts = RunParts(
            context.spec, context.archive, context.clock, context.watchdog, open_bench, self._open_head
        )
        self._lock = Condition()
        self._owner = HeadOwner(is_in_transfer=True)
        self._begin()

    @property
    def owner(self) -> HeadOwner:
        """The present owner."""
        with self._lock:
            return self._owner

    def calibrate(self, request: RunRequest | TrialLensRequest) -> None:
        """Start a calibration run after the exam has finished its captures and released the head.

        A run that waits for a request gets this one; it takes no trial lenses, because there is no valid calibration.
        Raises Busy if a calibration is under way, while the exam starts or during shutdown.
        """
        with self._lock:
            now = self._owner
            if now.is_closing:
                raise Busy("the instrument is being switched off", "Wait until it is back.")
            if now.session is None:
                exam = _releasable_exam(now)
                self._owner = replace(now, exam=None, calibration_failure=None, last_lenses=None, is_in_transfer=True)
        if now.session is not None:
            _start_waiting(now, request)
            return
        session: CalibrationSession | TrialLensSession | None = None
        try:
            self._release(exam)
            session = self._begin_session(request)
        finally:
            self._finish(session=session)

    def _begin_session(self, request: RunRequest | TrialLensRequest) -> CalibrationSession | TrialLensSession:
        if isinstance(request, TrialLensRequest):
            return TrialLensSession(self._run_parts, request, self._end_session)
        return CalibrationSession(self._run_parts, request, self._end_session)

    def close(self) -> None:
        """Permit no further transfer, and wait for the end of a running one."""
        with self._lock:
            self._owner = replace(self._owner, is_closing=True)
            self._lock.wait_for(lambda: not self._owner.is_in_transfer)

    def record_failure(self, failure: DiffuscopeError | None) -> None:
        """Record the error that ended the process; an earlier one stays."""
        with self._lock:
            self._owner = replace(self._owner, failure=self._owner.failure or failure)

    def _release(self, exam: ExamService) -> None:
        """Publish that captures are refused, then wait until the exam has released the head."""
        now = self.owner
        event_bus = self._context.event_bus
        problem = now.absence
        event_bus.publish("state", state=now.state)
        event_bus.publish("failed", code=problem.code, message=problem.message, remedy=problem.remedy)
        exam.close()

    def _end_session(self, outcome: RunOutcome) -> None:
        """Reopen the exam after a calibration run, which stays the owner until then. Called from the thread of the run.

        Stop the process instead if the run ended unexpectedly, or failed without a valid calibration.
        """
        with self._lock:
            self._lock.wait_for(lambda: not self._owner.is_in_transfer)  # a short run may end before it is recorded
            now = self._owner
            if outcome.result is not None and outcome.was_measured:
                now = replace(now, last_made_id=outcome.result.calibration.id)
            has_failed = outcome.failure is not None and now.calibration_error is not None
            is_last = outcome.is_unexpected or has_failed
            if not now.is_closing:
                now = replace(
                    now, calibration_failure=outcome.failure, last_lenses=outcome.lenses, is_in_transfer=not is_last
                )
            self._owner = now
        if now.is_closing:
            return
        if is_last:
            self._fail(outcome.failure)
            return
        try:
            self._begin()
        except DiffuscopeError as error:
            self._fail(error)

    def _begin(self) -> None:
        """Open the exam; without a valid calibration, begin a calibration run that waits for a request."""
        session = self.owner.session
        exam = None
        calibration_error = self.owner.calibration_error
        try:
            exam = self._open_exam()
            calibration_error = None
            session = None
        except (CalibrationError, HeadMismatch) as error:
            log.warning("calibration needed: %s", error)
            calibration_error = error
            session = CalibrationSession(self._run_parts, None, self._end_session)
        finally:
            self._finish(exam, session, calibration_error)

    def _finish(
        self,
        exam: ExamService | None = None,
        session: CalibrationSession | TrialLensSession | None = None,
        calibration_error: DiffuscopeError | None = None,
    ) -> None:
        """End a transfer with a new owner."""
        with self._lock:
            self._owner = replace(
                self._owner, exam=exam, session=session, calibration_error=calibration_error, is_in_transfer=False
            )
            self._lock.notify_all()

    def _open_head(self) -> Head:
        """Open the head with the calibration in force for trial lenses, whose light reaches no eye."""
        context = self._context
        spec = with_calibration(context.spec, context.archive.root)
        return open_head(spec, context.clock, MemoryLedger(context.clock))

    def _fail(self, error: DiffuscopeError | None) -> None:
        with self._lock:
            self._owner = replace(self._owner, failure=error)
        self._context.on_failure()


def _start_waiting(now: HeadOwner, request: RunRequest | TrialLensRequest) -> None:
    """Give the request to the run that owns the head; Busy, or the error because of which a calibration is needed."""
    if isinstance(now.session, CalibrationSession) and not isinstance(request, TrialLensRequest):
        now.session.start(request)
        return
    raise now.calibration_error or Busy("a calibration is under way", "Go on with it, or cancel it first.")


def _releasable_exam(now: HeadOwner) -> ExamService:
    """Return the exam, which can release the head; Busy during a transfer or while it starts, else `absence`."""
    if now.is_in_transfer:
        raise Busy("a calibration is under way", "Go on with it, or cancel it first.")
    if now.exam is None:
        raise now.absence
    if not now.exam.ready.is_set():
        raise Busy("the instrument is still getting ready", "Wait half a minute, then try again.")
    return now.exam


class HeadArbiter:
    """Arbiter that gives the head to the exam or to a calibration run, and what other parts read of them.

    The function `exam` opens the head with the calibration in force, `bench` opens it without one. If the calibration
    is missing or not valid, a calibration run owns the head and `owner.calibration_error` holds the error; the HTTP
    server runs in both cases.
    """

    def __init__(self, context: AppContext, exam: Callable[[], ExamService], bench: Callable[[], Bench]) -> None:
        self.context = context
        self._transfer = HeadTransfer(context, exam, bench)
        self._last_preview_s = -AIMING_S  # a float that any thread replaces: the latest request counts

    @property
    def owner(self) -> HeadOwner:
        """The present owner of the head, and the results of the last calibration run."""
        return self._transfer.owner

    @property
    def pressed_s(self) -> float | None:
        """Seconds since the button of the head was pressed; None if none can be read, or the exam has no head."""
        exam = self.owner.exam
        if exam is None or not exam.button.is_readable:
            return None
        return self.context.clock.now_s() - exam.button.pressed_at_s

    @property
    def exam(self) -> ExamService:
        """The exam; raises `HeadOwner.absence` while it does not own the head."""
        if (exam := (owner := self.owner).exam) is None:
            raise owner.absence
        return exam

    @property
    def head(self) -> Head | None:
        """The head of the exam, or None while the exam does not own it."""
        return exam.head if (exam := self.owner.exam) is not None else None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of the calibration monitor; empty while the exam does not own the head."""
        return exam.calibration_monitor.findings if (exam := self.owner.exam) is not None else ()

    @property
    def is_idle(self) -> bool:
        """Whether background work may run: no capture in progress and no live picture requested for AIMING_S.

        True while a calibration run owns the head, False while the exam starts.
        """
        if (exam := self.owner.exam) is None:
            return True
        return exam.state == "aim" and self.context.clock.now_s() - self._last_preview_s >= AIMING_S

    async def preview(self, after: int, wanted: LiveRequest = NO_VISIT) -> Preview | None:
        """Return the next live picture of the exam with a number above `after`; None without one within 2 s.

        While the exam does not own the head: None after NO_PREVIEW_S.
        """
        exam = self.owner.exam
        self._last_preview_s = self.context.clock.now_s()
        if exam is None:
            await asyncio.to_thread(self.context.clock.sleep, NO_PREVIEW_S)
            return None
        return await exam.preview(after, wanted=wanted)

    def calibrate(self, request: RunRequest | TrialLensRequest) -> None:
        """Start a calibration run after the exam has finished its captures and released the head.

        A run that waits for a request (no valid calibration) gets this one. Raises Busy if a calibration is under way,
        while the exam starts or during shutdown, SpecError for a recording; for trial lenses CalibrationMissing or
        CalibrationDamaged without a valid calibration in the archive.
        """
        refuse_recording(self.context.spec)
        if isinstance(request, TrialLensRequest):
            self.context.archive.load()  # raises before the exam is closed
        self._transfer.calibrate(request)

    def roll_back(self, id: str) -> None:
        """Put an earlier calibration in force and reopen the exam with it; wait at most CALIBRATION_STOP_TIMEOUT_S.

        Raises CalibrationMissing or CalibrationDamaged, and the errors of `calibrate`.
        """
        self.context.archive.load(id)  # raises for an invalid calibration before the exam is closed
        self.calibrate(RollbackRequest(id))
        if (session := self.owner.session) is not None:
            session.join(CALIBRATION_STOP_TIMEOUT_S)

    def stop_calibration(self) -> None:
        """Stop the calibration run, if any, and wait for its end, at most CALIBRATION_STOP_TIMEOUT_S.

        The calibration in force does not change.
        """
        if (session := self.owner.session) is not None:
            session.stop()
            session.join(CALIBRATION_STOP_TIMEOUT_S)

    def close(self) -> None:
        """Send STOPPING to systemd, stop the calibration run and close the exam; the lamp is off afterwards."""
        self.context.watchdog.stopping()
        self._transfer.close()
        self.stop_calibration()
        if (exam := self.owner.exam) is not None:
            exam.close()
            self._transfer.record_failure(exam.failure)


def archive_path(spec: InstrumentSpec, data: Path) -> Path:
    """Return the calibration archive of a head: the folder in its head file, else `data`/calibrations/HEAD-NAME."""
    if spec.calibration is not None:
        return spec.calibration.archive
    return data / "calibrations" / re.sub(r"[^a-z0-9]+", "-", spec.name.lower()).strip("-")


def with_calibration(spec: InstrumentSpec, archive: Path) -> InstrumentSpec:
    """Return the head specification with the calibration archive `archive`, or unchanged if it names one already.

    A replayed head gets none, a simulated head only if the archive is not empty.
    """
    if spec.calibration is not None or spec.camera.backend == "replay":
        return spec
    if spec.sim is not None and not Archive(archive).ids():
        return spec
    return spec.model_copy(update={"calibration": CalibrationTable(archive=archive)})
