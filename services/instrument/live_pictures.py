"""Live pictures between captures and during a refinement: aiming light, picture, aiming hint, pause."""

from collections.abc import Callable

from device.clock import Clock
from device.errors import DiffuscopeError
from device.head import Head
from services.errors import RequestRefused
from services.instrument.capture_pipeline import CapturePipeline
from services.instrument.exam_events import ExamEvents
from services.instrument.exam_requests import ExamRequests
from services.instrument.press_exposure import LiveFrame, expose_live
from services.instrument.shutter_button import ShutterButton

RETRY_S = 1.0


class LivePictures:
    """Live pictures while a client requests them. Not thread-safe: the thread `head` calls it.

    `refuse_in_vain` raises StoreError if no capture could be stored: then there is no aiming light either.
    """

    def __init__(
        self,
        head: Head,
        clock: Clock,
        pipeline: CapturePipeline,
        requests: ExamRequests,
        events: ExamEvents,
        refuse_in_vain: Callable[[], None],
        button: ShutterButton,
    ) -> None:
        self._head = head
        self._clock = clock
        self._pipeline = pipeline
        self._requests = requests
        self._events = events
        self._refuse_in_vain = refuse_in_vain
        self._button = button

    @property
    def are_wanted(self) -> bool:
        """Whether a client requested a live picture a short time ago."""
        return self._clock.now_s() < self._requests.snapshot.live_until_s

    def refresh(self) -> None:
        """Take one live picture, then keep the lamp off at least as long as it was on.

        After an error publish it and wait RETRY_S.
        """
        try:
            if (seen := self._take()) is None:
                return
        except DiffuscopeError as error:
            self._head.light.off()
            self._events.problem(error)
            self._pause(RETRY_S)
            return
        self._pause(2 * seen.dark_s - seen.exposed_s - self._clock.now_s())  # lamp duty cycle: at most 1/2

    def _take(self) -> LiveFrame | None:
        """Expose and show the next live picture; None if a press arrived or the consent was withdrawn."""
        wanted = self._requests.live_request
        try:
            wanted.permit()
        except RequestRefused:  # the consent was withdrawn after the request
            self._requests.withdraw(wanted)
            return None
        self._refuse_in_vain()
        seen = expose_live(self._head, wanted.eyes, self._clock, in_visit=wanted.visit is not None)
        if self._requests.snapshot.state.has_press:
            return None
        jpeg, aim = self._pipeline.live_picture(seen)
        self._events.aim(aim)
        self._events.problem(None)
        self._events.preview(jpeg, seen.exposed_s, aim)
        return seen

    def _pause(self, duration_s: float) -> None:
        """Sleep with the lamp off until `duration_s` is over, a press arrives, or the exam closes."""
        until_s = self._clock.now_s() + duration_s
        while not self._requests.snapshot.is_interrupted and (left_s := until_s - self._clock.now_s()) > 0:
            self._button.poll()
            self._clock.sleep(min(left_s, 0.02))
