"""Service of the exam: captures and live pictures on request, made by the one thread that owns the head.

exam_requests    the locked request side: state, waiting press, request for live pictures
exam_loop        the thread `head`: exposes, reconstructs and stores; `exam_state` holds its states
"""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from threading import Event, Thread

from device.clock import Clock
from device.errors import DiffuscopeError
from device.head import Head
from device.values import Eye
from services.instrument.calibration_monitor import CalibrationMonitor
from services.instrument.capture import NO_VISIT, LiveRequest, Press, Preview
from services.instrument.capture_pipeline import plan_pipeline
from services.instrument.events import EventBus
from services.instrument.exam_events import ExamEvents
from services.instrument.exam_loop import ExamParts, run_exam
from services.instrument.exam_requests import ExamRequests, ExamSnapshot
from services.instrument.exam_state import WireState
from services.instrument.progress import Progress
from services.instrument.record_origin import CaptureOrigin
from services.instrument.resumption import ResumedTarget, resumed_presses
from services.instrument.shutter_button import ShutterButton
from services.instrument.time_budget import SHUTDOWN_TIMEOUT_S
from services.instrument.watchdog import Watchdog
from services.records.capture import Capture
from services.records.capture_journal import CaptureJournal
from services.records.capture_store import CaptureStore
from services.records.capture_target import FRAMES, TEST_PICTURE, CaptureTarget


class ExamService:
    """Exam of one head: one capture for each press, and live pictures while a client requests them.

    Callable from any thread. The thread `head`, started here, owns the head until `close`; a press before `ready` waits
    until the FFT plans are made, a request for a live picture 2 s. After an error during planning, a LightFault of the
    lamp's `off` or an unexpected exception, `on_failure` is called, but not while the exam closes. `budget_s`
    returns the time budget of a capture, `plans` is the folder of the FFT plans. `resumed_target` returns the target of
    a capture that a kill has interrupted, whose frames are reconstructed first (resumption.py).
    """

    def __init__(
        self,
        head: Head,
        store: CaptureStore,
        event_bus: EventBus,
        clock: Clock,
        plans: Path,
        on_failure: Callable[[], None],
        watchdog: Watchdog,
        budget_s: Callable[[], float],
        resumed_target: ResumedTarget,
    ) -> None:
        self.head = head
        self.store = store
        self.ready = Event()
        self._clock = clock
        self._requests = requests = ExamRequests(clock)
        self.progress = Progress(clock, (FRAMES + 1) * head.spec.camera.exposure_s, budget_s)
        self.capture_journal = CaptureJournal(store)
        self.calibration_monitor = CalibrationMonitor(
            head, store, event_bus, clock, lambda: requests.snapshot.is_interrupted, watchdog
        )
        resumed = resumed_presses(self.capture_journal, resumed_target)
        for resumption in resumed:
            requests.remember(resumption.press)
        parts = ExamParts(
            head,
            store,
            clock,
            watchdog,
            budget_s,
            requests,
            ExamEvents(event_bus, watchdog, self.progress, requests),
            ShutterButton(head.button, event_bus),
            self.capture_journal,
            self.calibration_monitor,
            resumed,
        )
        origin = CaptureOrigin(head, store.folder)
        work = parts, lambda: plan_pipeline(head, clock, plans, origin), self.ready.set, on_failure
        self.button = parts.button
        self._thread = Thread(target=run_exam, args=work, name="head", daemon=True)
        self._thread.start()

    @property
    def snapshot(self) -> ExamSnapshot:
        """The present state, request for live pictures and output of the exam."""
        return self._requests.snapshot

    @property
    def state(self) -> WireState:
        """The state for the page: `starting` and `making` accept one press more, `aim` accepts one, `busy` none.

        While a press waits for the plans the state stays `starting`, and further presses are refused. So are all of
        them after the end of the exam, when the last state stays.
        """
        return self.snapshot.wire_state

    @property
    def problem(self) -> DiffuscopeError | None:
        """The error of the last live picture, StoreLocked for which a capture waits, or the one that ended the exam.

        None if there is none.
        """
        return self.snapshot.output.problem

    @property
    def failure(self) -> DiffuscopeError | None:
        """The reported error that ended the exam, of the planning or of the lamp's `off`; None if there is none."""
        return self.snapshot.output.failure

    def press(self, eye: Eye, key: str | None = None, target: CaptureTarget = TEST_PICTURE) -> Future[Capture]:
        """Request one capture; return a future of the stored capture.

        `key` is an idempotency key: a repeated key returns the same future. Raises IdempotencyKeyConflict if the key
        belongs to another eye, visit or slot, Busy while another press waits or is exposed, with two captures in
        progress or after close, CalibrationExpired or CalibrationStale if the calibration is not valid.
        """
        future: Future[Capture] = Future()
        future.set_running_or_notify_cancel()  # a client that disconnects cannot cancel the capture
        return self._requests.press(
            Press(future, eye, target, key, self._clock.now_s()), self.calibration_monitor.refusal()
        )

    async def preview(self, after: int, wait_s: float = 2.0, wanted: LiveRequest = NO_VISIT) -> Preview | None:
        """Return the next live picture with a number above `after`; None after `wait_s` seconds or at close.

        Its dose counts for the eyes of `wanted`; by default for both.
        """
        return await self._requests.preview(after, wait_s, wanted)

    def quick(self, id: str) -> bytes | None:
        """Return the JPEG quick look of the capture in progress `id`; None if there is none."""
        return self.snapshot.output.quick_looks.get(id)

    def close(self) -> None:
        """Store the captures that are exposed, then close the head with the lamp off, for use by another owner.

        Wait for them at most SHUTDOWN_TIMEOUT_S. A press that is not exposed yet fails with Busy.
        """
        self._requests.close()
        self._thread.join(timeout=SHUTDOWN_TIMEOUT_S)
        self.head.close()
