"""The story of a picture: light, expose, dark, reconstruct, keep, show.

One thread owns the head, so nothing in the device needs a lock. A press goes before the live preview; a second press
while one is under way is refused, not queued. Every way out of the story leaves the lamp dark.
"""

import json
import logging
import secrets
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from typing import Any

import numpy as np

from device.clock import Clock, Deadline
from device.errors import Busy, DiffuscopeError, LightLimit
from device.head import Head
from device.recon.focus import sharpest
from device.recon.model import field_box
from device.recon.plan import Planner
from device.recon.reconstructor import Reconstructor, Stage, ladder
from device.values import Capture, Eye, Frame, Glow, Image, Reconstruction, Shot
from services.instrument.bulletin import Bulletin
from services.records import picture
from services.records.store import Store

log = logging.getLogger(__name__)

BUDGET_S = 5.0
PREVIEW_BUDGET_S = 0.2
PREVIEW_PX = 480
QUICK_PX = 640
RETRY_S = 1.0
WANTED_S = 3.0  # the preview goes on this long after somebody last asked for it, then the lamp rests
REMEMBERED = 32  # presses whose key is known, so that a request which the network repeats makes one picture


@dataclass(frozen=True)
class Preview:
    """One live picture: its number, its JPEG, and when it was exposed."""

    number: int
    jpeg: bytes
    exposed_s: float


class Exam:
    """The one who owns the head: takes pictures on a press, and live ones while somebody looks."""

    def __init__(
        self, head: Head, store: Store, bulletin: Bulletin, clock: Clock, plans: Path, died: Callable[[], None]
    ) -> None:
        self.head, self.store, self.bulletin, self.clock = head, store, bulletin, clock
        self.problem: DiffuscopeError | None = None
        self._died = died
        planner = Planner(plans)
        index = self._best_psf(planner)
        recipes = ladder(head.calibration, head.camera.shape, index)
        self._reconstructor = Reconstructor(head.calibration, head.camera.shape, planner, clock, recipes, index)
        self.planned = planner.planned
        self._quick: dict[str, bytes] = {}
        self._turn = Condition()
        self._press: tuple[Future[Capture], Eye] | None = None
        self._busy = self._closing = self._ended = False
        self._wanted_until_s = 0.0
        self._preview = Preview(0, b"", 0.0)
        self._pressed: OrderedDict[str, Future[Capture]] = OrderedDict()
        self._owner = Thread(target=self._own_the_head, name="head", daemon=True)
        self._owner.start()

    def _best_psf(self, planner: Planner) -> int:
        """A recording may bring PSFs of several depths: the first frame tells which one is its own."""
        if len(self.head.calibration.psfs) == 1:
            return 0
        frame, _ = self._expose(self.head.spec.camera.exposure_s)
        return sharpest(self.head.calibration, frame.counts, planner)[0]

    # What others ask of it, from any thread

    @property
    def state(self) -> str:
        """`busy` while a press is under way, else `aim`."""
        return "busy" if self._busy else "aim"

    def press(self, eye: Eye, key: str | None = None) -> Future[Capture]:
        """Take one picture; the future holds what was kept. Raises Busy while another is under way or at the end.

        The same `key` again gives the same picture, however often the network repeats the request.
        """
        with self._turn:
            if key is not None and key in self._pressed:
                return self._pressed[key]
            if self._closing or self._ended:
                raise Busy("the instrument is being switched off", "Wait until it is back, then press again.")
            if self._busy:
                raise Busy("a picture is being taken")
            self._busy = True
            future: Future[Capture] = Future()
            future.set_running_or_notify_cancel()  # a page that goes away does not take the picture with it
            self._press = future, eye
            if key is not None:
                self._pressed[key] = future
                while len(self._pressed) > REMEMBERED:
                    self._pressed.popitem(last=False)
            self._turn.notify_all()
        return future

    def preview(self, after: int, wait_s: float = 2.0) -> Preview | None:
        """The next live picture after number `after`; None when none comes in `wait_s`."""
        with self._turn:
            self._wanted_until_s = self.clock.now_s() + WANTED_S
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._preview.number > after or self._closing, wait_s)
            return self._preview if self._preview.number > after else None

    def quick(self, id: str) -> bytes | None:
        """The quick look of the press under way, which the store does not have yet."""
        return self._quick.get(id)

    def close(self) -> None:
        """Finish what is under way, then let the head go, dark."""
        with self._turn:
            self._closing = True
            self._turn.notify_all()
        self._owner.join(timeout=10)
        self.head.close()

    # What the owner does, alone

    def _own_the_head(self) -> None:
        """Until it is closed; what nobody foresaw ends the process, dark: a restart is safer than a half-alive head."""
        try:
            while (act := self._next()) is not None:
                act()
        finally:
            self.head.light.off()
            self._end()
            if not self._closing:
                self.problem = DiffuscopeError("the instrument stopped unexpectedly")
                self._died()

    def _end(self) -> None:
        """Nobody waits for a picture that will never be taken."""
        with self._turn:
            self._ended = True
            waiting, self._press = self._press, None
        if waiting is not None:
            waiting[0].set_exception(Busy("the instrument was switched off before the picture was taken"))

    def _next(self) -> Callable[[], None] | None:
        with self._turn:
            while not self._closing:
                if self._press is not None:
                    act, self._press = partial(self._answer, *self._press), None
                    return act
                if self.clock.now_s() < self._wanted_until_s:
                    return self._look
                self._turn.wait()
        return None

    def _answer(self, future: Future[Capture], eye: Eye) -> None:
        self.bulletin.tell("state", state="busy")
        try:
            kept = self._take(eye)
        except DiffuscopeError as error:
            log.warning("press failed: %s", error)
            self.bulletin.tell("failed", code=error.code, message=error.message, remedy=error.remedy)
            self._free()
            future.set_exception(error)
        except BaseException:
            self._free()
            future.set_exception(DiffuscopeError("the instrument stopped unexpectedly"))
            raise
        else:
            self._report_problem(None)
            self._free()
            future.set_result(kept)

    def _free(self) -> None:
        self.head.light.off()
        with self._turn:
            self._busy = False
            self._quick.clear()
        self.bulletin.tell("state", state="aim")

    def _take(self, eye: Eye) -> Capture:
        """The story itself."""
        taken_at = self.clock.wall()
        id = Capture.named(taken_at, eye, secrets.token_hex(3))
        self._tell_stage(id, "expose", 0.1)
        begin_s = self.clock.now_s()
        frame, dark = self._expose(self.head.spec.camera.exposure_s)
        exposed_s = self.clock.now_s()
        made = self._reconstruct(id, frame, dark)
        report = asdict(made.report)
        report["seconds"] = {"expose": exposed_s - begin_s, **made.report.seconds}
        plain = json.loads(_json_bytes(report))  # as it will be read back: lists for tuples, floats for numpy's
        capture = Capture(id, eye, taken_at, made.simulated, self.head.calibration.id, plain, {})
        self._tell_stage(id, "keep", 0.9)
        kept = self.store.keep(capture, self._files(capture, frame, dark, made))
        self.bulletin.tell("kept", id=id)
        return kept

    def _expose(self, exposure_s: float) -> tuple[Frame, Frame]:
        """A lit frame and a dark one."""
        camera, light = self.head.camera, self.head.light
        try:
            with light.on(Glow(self.head.spec.light.colour)):
                frame = _lit(camera.expose(Shot(exposure_s)))
            return frame, camera.expose(Shot(exposure_s))
        finally:
            light.off()

    def _reconstruct(self, id: str, frame: Frame, dark: Frame) -> Reconstruction:
        def show(stage: Stage) -> None:
            if not stage.last:
                self._quick[id] = picture.to_jpeg(stage.picture, QUICK_PX, frame.simulated)
                self._tell_stage(id, "quick", 0.4, f"/api/captures/{id}/quick.jpg")

        deadline = Deadline.after(self.clock, BUDGET_S)
        return self._reconstructor(frame.counts, dark.counts, simulated=frame.simulated, deadline=deadline, watch=show)

    def _files(self, capture: Capture, frame: Frame, dark: Frame, made: Reconstruction) -> dict[str, bytes]:
        facts = {
            "id": capture.id, "eye": capture.eye, "taken_at": capture.taken_at.isoformat(),
            "exposure_s": frame.exposure_s, "glow": asdict(frame.glow) if frame.glow else None,
            "simulated": frame.simulated, "calibration_id": capture.calibration_id, "head": self.head.spec.name,
        }  # fmt: skip
        return {
            "raw.tiff": picture.raw_tiff(frame.counts, facts),
            "dark.tiff": picture.raw_tiff(dark.counts, facts | {"glow": None}),
            "picture.png": picture.to_png(
                self._eye(made.picture), made.simulated, f"{capture.eye} {capture.taken_at:%Y-%m-%d}"
            ),
            "quick.jpg": self._quick.get(capture.id)
            or picture.to_jpeg(self._eye(made.picture), QUICK_PX, made.simulated),
            "report.json": _json_bytes(capture.report | {"simulated": made.simulated}),
        }

    def _eye(self, image: Image) -> Image:
        """The part of a picture that people look at: the illuminated field."""
        return image[field_box(self.head.calibration, self.head.camera.shape)]

    def _look(self) -> None:
        """One live picture; what goes wrong is shown, and tried again a second later."""
        try:
            jpeg, exposed_s, dark_s = self._live_picture()
        except DiffuscopeError as error:
            self.head.light.off()
            self._report_problem(error)
            self._pause(RETRY_S)
            return
        self._report_problem(None)
        with self._turn:
            self._preview = Preview(self._preview.number + 1, jpeg, exposed_s)
            self._turn.notify_all()
        self._pause(2 * dark_s - exposed_s - self.clock.now_s())  # as much darkness as there was light

    def _pause(self, duration_s: float) -> None:
        """Do nothing, in the dark, but go on at once when somebody presses."""
        until_s = self.clock.now_s() + duration_s
        while self._press is None and not self._closing and (left_s := until_s - self.clock.now_s()) > 0:
            self.clock.sleep(min(left_s, 0.02))

    def _live_picture(self) -> tuple[bytes, float, float]:
        """A JPEG, and the moments at which its light went on and off: aiming must not use up the picture's light."""
        spec = self.head.spec
        try:
            with self.head.light.on(Glow(spec.light.preview_colour)):
                exposed_s = self.clock.now_s()
                frame = _lit(self.head.camera.expose(Shot(spec.camera.preview_exposure_s)))
        finally:
            self.head.light.off()
            dark_s = self.clock.now_s()
        deadline = Deadline.after(self.clock, PREVIEW_BUDGET_S)
        made = self._reconstructor(frame.counts, simulated=frame.simulated, deadline=deadline, quick=True)
        return picture.to_jpeg(self._eye(made.picture), PREVIEW_PX, made.simulated), exposed_s, dark_s

    def _report_problem(self, error: DiffuscopeError | None) -> None:
        before = self.problem.code if self.problem else None
        self.problem = error
        if error is not None and error.code != before:
            log.warning("preview: %s", error)
            self.bulletin.tell("failed", code=error.code, message=error.message, remedy=error.remedy)

    def _tell_stage(self, id: str, stage: str, fraction: float, url: str | None = None) -> None:
        self.bulletin.tell("stage", id=id, stage=stage, fraction=fraction, left_s=0.0, url=url)


def _lit(frame: Frame) -> Frame:
    if frame.glow is None:
        raise LightLimit("the light went out during the exposure: it had been on for too long")
    return frame


def _json_bytes(data: dict[str, Any]) -> bytes:
    return json.dumps(data, indent=1, default=_plain).encode()


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value)} does not belong into a report")
