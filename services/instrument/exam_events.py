"""Publication of what happens in the exam: on the event bus, to systemd, and as the output of the exam."""

import logging
from dataclasses import asdict, replace
from types import MappingProxyType

from device.errors import DiffuscopeError
from device.recon.assessment.aiming import Aim
from device.values import Image, Verdict
from services.imaging import picture_files
from services.instrument.capture import THUMBNAIL_PX, Press, Preview
from services.instrument.events import EventBus
from services.instrument.exam_requests import ExamOutput, ExamRequests
from services.instrument.progress import Progress, ProgressEstimate
from services.instrument.watchdog import Watchdog

log = logging.getLogger(__name__)


class ExamEvents:
    """Publisher of the exam. Not thread-safe: the thread `head` calls it, without a lock.

    The thread of the preparation calls `quick_look` with `is_exposing`, while `head` exposes and publishes nothing.
    """

    def __init__(self, event_bus: EventBus, watchdog: Watchdog, progress: Progress, requests: ExamRequests) -> None:
        self._event_bus, self._watchdog, self._progress, self._requests = event_bus, watchdog, progress, requests
        self._published_state = "starting"
        self._published_aim: Aim | None = None

    @property
    def output(self) -> ExamOutput:
        """What other threads see; only the publisher changes it."""
        return self._requests.snapshot.output

    def state(self) -> None:
        """Publish the state if it has changed, on the event bus and to systemd."""
        state = self._requests.snapshot.wire_state
        if state != self._published_state:
            self._published_state = state
            self._event_bus.publish("state", state=state)
            self._watchdog.status(state)

    def stage(self, press: Press, id: str, stage: str, url: str | None = None) -> None:
        """Publish that a capture has reached a stage, with the URL of its quick look if it has one."""
        self._watchdog.beat()
        self._event_bus.publish("stage", **stage_event(press, id, self._progress.enter_stage(id, stage), url))

    def progress(self, press: Press, id: str) -> None:
        """Publish the estimated progress of a capture within its stage."""
        self._event_bus.publish("stage", **stage_event(press, id, self._progress.estimate(id)))

    def quick_look(self, press: Press, id: str, look: Image, simulated: bool, *, is_exposing: bool = False) -> None:
        """Publish the quick look of a capture in progress.

        With `is_exposing` it remains in its stage: the next frames are being exposed. The thread of the preparation
        calls this then, while the thread `head` publishes nothing.
        """
        jpeg = picture_files.to_jpeg(look, THUMBNAIL_PX, simulated)
        before = self.output.quick_looks.get(id)
        # Where the first frame is not the reference the page has the look of another frame: a new URL replaces it.
        url = f"/api/captures/{id}/quick.jpg" + ("" if before in (None, jpeg) else "?reference")
        self._show_quick_looks({**self.output.quick_looks, id: jpeg})
        if is_exposing:
            self._event_bus.publish("stage", **stage_event(press, id, self._progress.estimate(id), url))
        else:
            self.stage(press, id, "quick", url)

    def forget_quick_look(self, id: str) -> None:
        """Remove the quick look of a capture that is no longer in progress."""
        self._show_quick_looks({capture: jpeg for capture, jpeg in self.output.quick_looks.items() if capture != id})

    def verdict(self, id: str, verdict: Verdict) -> None:
        """Publish the verdict on a capture."""
        self._event_bus.publish("verdict", id=id, **asdict(verdict))

    def kept(self, id: str) -> None:
        """Publish that a capture is stored, and end its progress."""
        self._progress.finish(id, kept=True)
        self._event_bus.publish("kept", id=id)

    def failed(self, id: str, error: DiffuscopeError) -> None:
        """Publish that a capture has failed, end its progress, and remove its quick look."""
        self._progress.finish(id, kept=False)
        self.forget_quick_look(id)
        log.warning("capture failed: %s", error, extra={"code": error.code})
        self._event_bus.publish("failed", id=id, code=error.code, message=error.message, remedy=error.remedy)

    def aim(self, aim: Aim) -> None:
        """Publish an aiming hint if its code has changed."""
        if self._published_aim is None or self._published_aim.code != aim.code:
            self._published_aim = aim
            self._event_bus.publish("aim", **asdict(aim))

    def preview(self, jpeg: bytes, exposed_s: float, aim: Aim) -> None:
        """Show the next live picture."""
        number = self.output.preview.number + 1
        self._requests.show(replace(self.output, preview=Preview(number, jpeg, exposed_s, aim)))

    def problem(self, error: DiffuscopeError | None) -> None:
        """Show the error of the last live picture, or the one for which a capture waits; None if there is none.

        It is published if its code has changed.
        """
        before = self.output.problem
        self._requests.show(replace(self.output, problem=error))
        if error is not None and error.code != (before.code if before else None):
            log.warning("no picture now: %s", error, extra={"code": error.code})
            self._event_bus.publish("failed", code=error.code, message=error.message, remedy=error.remedy)

    def ended(self, problem: DiffuscopeError | None, failure: DiffuscopeError | None) -> None:
        """Show the error that ended the exam, after a close (None) the one before; `failure`: see `ExamOutput`."""
        self._requests.show(replace(self.output, problem=problem or self.output.problem, failure=failure))

    def _show_quick_looks(self, quick_looks: dict[str, bytes]) -> None:
        self._requests.show(replace(self.output, quick_looks=MappingProxyType(quick_looks)))


def stage_event(press: Press, id: str, now: ProgressEstimate, url: str | None = None) -> dict[str, object]:
    """Return the data of the event `stage`: progress of capture `id`, URL of its quick look, and its press."""
    return {
        "id": id,
        "stage": now.stage,
        "fraction": now.fraction,
        "left_s": round(now.left_s, 2),
        "url": url,
        "key": press.key,
        "visit": press.target.visit,
        "slot": press.target.slot,
    }
