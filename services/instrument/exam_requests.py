"""Request side of the exam: its state, the waiting press and the request for live pictures, behind one lock."""

import asyncio
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from threading import Condition
from types import MappingProxyType

from device.clock import Clock
from device.errors import DiffuscopeError
from services.errors import Busy
from services.instrument.capture import NO_VISIT, IdempotencyKeys, LiveRequest, Press, Preview
from services.instrument.exam_state import ExamEvent, ExamState, WireState, transition
from services.instrument.frame_feedback import NO_AIM
from services.instrument.wakeups import Wakeups
from services.records.capture import Capture

NO_PREVIEW = Preview(0, b"", 0.0, NO_AIM)
WANTED_S = 3.0  # the live pictures continue this long after the last request, then the lamp stays off


@dataclass(frozen=True)
class ExamOutput:
    """What the thread `head` shows to other threads.

    `preview`: latest live picture (number 0 before the first). `problem`: error of the last live picture, the
    StoreLocked for which a capture waits, or the one that ended the exam. `failure`: the last of these, if it
    is a reported error (of the planning, or LightFault of a lamp that cannot be turned off), no unexpected exception.
    `quick_looks`: JPEG by id of a capture in progress.
    """

    preview: Preview = NO_PREVIEW
    problem: DiffuscopeError | None = None
    failure: DiffuscopeError | None = None
    quick_looks: Mapping[str, bytes] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class ExamSnapshot:
    """Immutable state of the exam at one moment; a change makes a new snapshot.

    `wire_state` keeps its value when the exam ends. `live_until_s`: clock seconds until which live pictures are taken.
    """

    state: ExamState = ExamState.STARTING
    wire_state: WireState = "starting"
    is_closing: bool = False
    live_until_s: float = 0.0
    output: ExamOutput = ExamOutput()

    @property
    def has_press(self) -> bool:
        """Whether a press waits for its exposure and will get it: the exam is not closing."""
        return self.state.has_press and not self.is_closing

    @property
    def is_interrupted(self) -> bool:
        """Whether work in idle time must stop: a press waits, or the exam is closing."""
        return self.state.has_press or self.is_closing


class ExamRequests:
    """Requests of any thread to the exam, and its state. Thread-safe.

    The mutex `_lock` guards every field that changes. It is never held over input or output, a solver round or a
    callback; `wait` releases it, and `preview` waits without it. The thread `head` alone calls `wait`, `advance`,
    `take_press`, `live_request`, `withdraw`, `show` and `end`; `show` also that of the preparation, while `head`
    exposes.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = Condition()
        self._preview_wakeups = Wakeups()
        self._snapshot = ExamSnapshot()
        self._pending: Press | None = None
        self._live_request = NO_VISIT
        self._idempotency_keys = IdempotencyKeys()

    @property
    def snapshot(self) -> ExamSnapshot:
        """The present snapshot."""
        with self._lock:
            return self._snapshot

    def press(self, press: Press, refusal: DiffuscopeError | None) -> Future[Capture]:
        """Accept a press and return its future; for a known idempotency key, return the future of the earlier press.

        Raises IdempotencyKeyConflict if the key belongs to another eye, visit or slot, Busy if the exam takes no press
        now, else `refusal` if it is given: the error of a calibration that is not valid. Consent and slot are checked
        before this call by the endpoint, consent again and head and light when the press is exposed.
        """
        with self._lock:
            if (known := self._idempotency_keys.find(press.key, press.eye, press.target)) is not None:
                return known
            if self._snapshot.is_closing or self._snapshot.state is ExamState.ENDED:
                raise Busy("the instrument is being switched off", "Wait until it is back, then press again.")
            if not self._snapshot.state.accepts_press:
                raise Busy("a picture is being taken")
            if refusal is not None:
                raise refusal
            self._advance(ExamEvent.PRESS)
            self._pending = press
            self._idempotency_keys.remember(press)
        return press.future

    def remember(self, press: Press) -> None:
        """Store a press of the run before under its idempotency key: a repeated request gets its capture."""
        with self._lock:
            self._idempotency_keys.remember(press)

    async def preview(self, after: int, wait_s: float, wanted: LiveRequest) -> Preview | None:
        """Request live pictures; return the next one with a number above `after`, None after `wait_s` or at close."""
        with self._lock:
            self._live_request = wanted
            self._change(replace(self._snapshot, live_until_s=self._clock.now_s() + WANTED_S))
        with self._preview_wakeups.subscribed() as wakeup, suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                while (now := self.snapshot).output.preview.number <= after and not now.is_closing:
                    await wakeup.wait()
                    wakeup.clear()
        latest = self.snapshot.output.preview
        return latest if latest.number > after else None

    def close(self) -> None:
        """Request the end of the exam: exposed captures are stored first, a press without light fails."""
        with self._lock:
            self._change(replace(self._snapshot, is_closing=True))
        self._preview_wakeups.wake()

    # Called from the thread `head` only

    def wait(self, seen: ExamSnapshot, timeout_s: float) -> None:
        """Wait until the snapshot is another one than `seen`, at most `timeout_s` seconds of real time."""
        with self._lock:
            self._lock.wait_for(lambda: self._snapshot is not seen, timeout_s)

    def advance(self, event: ExamEvent) -> None:
        """Apply an event to the state; RuntimeError if the table does not declare it there."""
        with self._lock:
            self._advance(event)

    def take_press(self) -> Press:
        """Return the waiting press, whose exposure begins; aiming is over, live pictures need a new request."""
        with self._lock:
            press = self._pending
            self._pending = None
            self._advance(ExamEvent.EXPOSE)
            self._change(replace(self._snapshot, live_until_s=0.0))  # aiming is over
        assert press is not None
        return press

    @property
    def live_request(self) -> LiveRequest:
        """The latest request for live pictures."""
        with self._lock:
            return self._live_request

    def withdraw(self, request: LiveRequest) -> None:
        """End the live pictures of a request; a newer request stays valid."""
        with self._lock:
            if self._live_request is request:
                self._change(replace(self._snapshot, live_until_s=0.0))

    def show(self, output: ExamOutput) -> None:
        """Replace what other threads see, and wake the requests that wait for a live picture."""
        with self._lock:
            self._change(replace(self._snapshot, output=output))
        self._preview_wakeups.wake()

    def end(self) -> Press | None:
        """End the exam; return the press that waits, if any, for the caller to fail."""
        with self._lock:
            self._advance(ExamEvent.END)
            press = self._pending
            self._pending = None
        return press

    # The caller holds the lock

    def _advance(self, event: ExamEvent) -> None:
        state = transition(self._snapshot.state, event)
        wire_state = self._snapshot.wire_state if state.wire_state is None else state.wire_state
        self._change(replace(self._snapshot, state=state, wire_state=wire_state))

    def _change(self, snapshot: ExamSnapshot) -> None:
        self._snapshot = snapshot
        self._lock.notify_all()
