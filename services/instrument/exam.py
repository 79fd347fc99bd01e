"""The story of a picture: light, expose, dark, reconstruct, keep, show.

One thread owns the head, so nothing in the device needs a lock. A press goes before everything: between two rounds of a
refinement it is exposed and gets its quick look, and then the refinement goes on. A third press is refused, not queued.
Every way out of the story leaves the lamp dark.
"""

import logging
import secrets
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Condition, Event, Thread

from device.clock import Clock, Deadline
from device.errors import Busy, DiffuscopeError, FrameError, LightFault, Refused, StoreError
from device.head import Head
from device.recon.focus import sharpest
from device.recon.plan import Planner
from device.recon.reconstructor import Reconstructor, Stage, ladder
from device.values import EYES, Calibration, Capture, Eye, Image, Reconstruction
from services.instrument.aside import aside
from services.instrument.bulletin import Bulletin
from services.instrument.exposing import expose, expose_live, eye_in
from services.instrument.filing import QUICK_PX, capture_files, report_of, unmade
from services.instrument.fitness import Fitness
from services.instrument.judging import NOWHERE, Watch
from services.instrument.pace import BUDGET_S, LAST_S, SEATS
from services.instrument.press import NO_VISIT, Exposed, Keys, LiveRequest, Press, Preview
from services.instrument.progress import Progress
from services.instrument.watchdog import BEAT_S, Watchdog
from services.records import picture
from services.records.errand import NO_ERRAND, Errand
from services.records.store import Store
from services.records.underway import Underway

log = logging.getLogger(__name__)

PREVIEW_BUDGET_S = 0.2
PREVIEW_PX = 480
RETRY_S = 1.0
LIVE_S = 0.4  # while a picture is refined, pages hear this often how far it is, and who aims sees a live picture
WANTED_S = 3.0  # the preview goes on this long after somebody last asked for it, then the lamp rests


class Exam:
    """The one who owns the head: takes pictures on a press, and live ones while somebody looks.

    Ready at once to be asked; what it is asked waits until the plans are made (`ready`). Where that fails, `failure`
    says why, and `died` is called, as after anything that nobody foresaw.
    """

    def __init__(
        self, head: Head, store: Store, bulletin: Bulletin, clock: Clock, plans: Path, died: Callable[[], None],
        watchdog: Watchdog, budget_s: Callable[[], float] = lambda: BUDGET_S,
    ) -> None:  # fmt: skip
        self.head, self.store, self.bulletin, self.clock = head, store, bulletin, clock
        self.problem: DiffuscopeError | None = None
        self.failure: DiffuscopeError | None = None
        self.ready = Event()
        self._died, self._plans, self._watchdog, self._budget_s = died, plans, watchdog, budget_s
        self._quick: dict[str, bytes] = {}
        self._turn = Condition()
        self._press: Press | None = None
        self._exposing = self._closing = self._ended = False
        self._exposed: deque[Exposed] = deque()
        self._in_the_making = 0
        self._wanted_until_s = self._alive_s = 0.0
        self._wanted = NO_VISIT
        self._preview = Preview(0, b"", 0.0, NOWHERE)
        self._told = "starting"
        self._pressed = Keys()
        self.progress = Progress(bulletin, clock, head.spec.camera.exposure_s, budget_s)
        self.underway = Underway(store)
        self.fitness = Fitness(head, store, bulletin, clock, lambda: self._press is not None or self._closing, watchdog)
        self._owner = Thread(target=self._own_the_head, name="head", daemon=True)
        self._owner.start()

    # What others ask of it, from any thread

    @property
    def state(self) -> str:
        """`starting`; `busy`: presses are refused; `making`: a picture is made, presses are accepted; else `aim`."""
        if not self.ready.is_set():
            return "starting"
        if self._is_busy():
            return "busy"
        return "making" if self._in_the_making else "aim"

    def _is_busy(self) -> bool:
        return self._press is not None or self._exposing or self._in_the_making == SEATS

    def press(self, eye: Eye, key: str | None = None, errand: Errand = NO_ERRAND) -> Future[Capture]:
        """Take one picture; the future holds what was kept. Raises Busy while no press can be taken.

        Raises CalibrationOld or CalibrationStale where no picture should rest on the calibration.
        The same `key` again gives the same picture; InputError if it was that of another eye, visit or slot.
        """
        with self._turn:
            if (known := self._pressed.known(key, eye, errand)) is not None:
                return known
            if self._closing or self._ended:
                raise Busy("the instrument is being switched off", "Wait until it is back, then press again.")
            if self._is_busy():
                raise Busy("a picture is being taken")
            self.fitness.refuse()
            self._press = Press(Future(), eye, errand, key)
            future = self._press.answer
            future.set_running_or_notify_cancel()  # a page that goes away does not take the picture with it
            self._in_the_making += 1
            if key is not None:
                self._pressed.remember(key, self._press)
            self._turn.notify_all()
        return future

    def preview(self, after: int, wait_s: float = 2.0, wanted: LiveRequest = NO_VISIT) -> Preview | None:
        """The next live picture after number `after` as it is `wanted`; None when none comes in `wait_s`.

        Its light counts for both eyes unless `wanted` names one.
        """
        with self._turn:
            self._wanted = wanted
            self._wanted_until_s = self.clock.now_s() + WANTED_S
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._preview.number > after or self._closing, wait_s)
            return self._preview if self._preview.number > after else None

    def quick(self, id: str) -> bytes | None:
        """The quick look of the press under way, which the store does not have yet."""
        return self._quick.get(id)

    def close(self) -> None:
        """Say that the instrument ends, and end."""
        self._watchdog.stopping()
        self.hand_over()

    def hand_over(self) -> None:
        """Finish what is under way, then let the head go, dark: somebody else may take it."""
        with self._turn:
            self._closing = True
            self._turn.notify_all()
        self._owner.join(timeout=LAST_S)
        self.head.close()

    # What the owner does, alone

    def _own_the_head(self) -> None:
        """Until it is closed; what nobody foresaw ends the process, dark: a restart is safer than a half-alive head."""
        try:
            self._watchdog.status("making plans")
            self._plan()
            self.ready.set()
            self._watchdog.ready()
            self._tell_state()
            while (act := self._next()) is not None:
                act()
        except DiffuscopeError as error:  # of the planning: whatever comes later answers the press that it belongs to
            self.failure = error
        finally:
            with suppress(LightFault):  # then its guardian, and whoever ends this process, must darken it
                self.head.light.off()
            self._end()
            if not self._closing:
                self.problem = self.failure or DiffuscopeError("the instrument stopped unexpectedly")
                self._died()

    def _plan(self) -> None:
        planner, said, shape = Planner(self._plans), self.head.spec.light, self.head.camera.shape
        calibration, live = (self.head.calibration.seen_in(colour) for colour in (said.colour, said.preview_colour))
        index = self._best_psf(calibration, planner)
        recipes = ladder(calibration, shape, index)
        self._reconstructor = self._live = Reconstructor(calibration, shape, planner, self.clock, recipes, index)
        if live.psfs[0] is not calibration.psfs[0]:  # aiming has a colour, and that colour a PSF, of its own
            self._live = Reconstructor(live, shape, planner, self.clock, recipes[:1], refract=False)
        self.fitness.begin(self._reconstructor.refractor)
        self._eyes = Watch(calibration, shape, planner, index, self.head.spec.camera, self.bulletin)

    def _best_psf(self, calibration: Calibration, planner: Planner) -> int:
        """A recording may bring PSFs of several depths: the first frame tells which one is its own."""
        if len(calibration.psfs) == 1:
            return 0
        frame, _ = expose(self.head, EYES)
        return sharpest(calibration, frame.counts, planner)[0]

    def _end(self) -> None:
        """Nobody waits for a picture that will never be taken."""
        with self._turn:
            self._ended = True
            waiting = [shot.press for shot in self._exposed] + ([self._press] if self._press else [])
            self._press = None
            self._exposed.clear()
        for press in waiting:
            press.answer.set_exception(Busy("the instrument was switched off before the picture was taken"))

    def _next(self) -> Callable[[], None] | None:
        with self._turn:
            while not self._closing or self._exposed:
                self._watchdog.beat()
                if self._press is not None and not self._closing:
                    return self._answer
                if self._exposed:
                    return self._develop
                if self.fitness.due and not self._closing:
                    return self.fitness.step
                if self.clock.now_s() < self._wanted_until_s:
                    return self._look
                self._turn.wait(BEAT_S)
        return None

    def _answer(self) -> None:
        """Expose what was pressed; its picture is made next."""
        with self._turn:
            press, self._press, self._exposing = self._press, None, True
            self._wanted_until_s = 0.0  # aiming is over; who aims on will ask, and the lamp shines for nobody else
        assert press is not None
        self._tell_state()
        taken_at = self.clock.wall()
        id = Capture.named(taken_at, press.eye, secrets.token_hex(3))
        with self._answering(press, id):
            press.errand.permit()  # again: it may have been withdrawn while the press waited
            self.underway.begin(press.under_way(id), press.key)
            self._tell_stage(press, id, "expose")
            begin_s = self.clock.now_s()
            frame, dark = expose(self.head, (press.eye,))
            exposed = press, id, taken_at, frame, dark, self.clock.now_s() - begin_s
            verdict = self._eyes.judge(id, frame.counts, dark.counts, begin_s)
            self._exposed.append(Exposed(*exposed, light=self.head.light.account(), verdict=verdict))
        self._exposing = False
        self._tell_state()

    def _develop(self) -> None:
        """Make and keep the picture of the oldest exposure."""
        shot = self._exposed.popleft()
        with self._answering(shot.press, shot.id):
            kept = self._make(shot)
            self._over(shot.id, kept=True, key=shot.press.key)
            self._report_problem(None)
            self._leave(shot.press)
            shot.press.answer.set_result(kept)
        self._quick.pop(shot.id, None)

    @contextmanager
    def _answering(self, press: Press, id: str) -> Iterator[None]:
        """Whatever happens to a press, the lamp is dark after it, and whoever waits for it hears."""
        try:
            yield
        except DiffuscopeError as error:
            log.warning("press failed: %s", error, extra={"code": error.code})
            self.bulletin.tell("failed", id=id, code=error.code, message=error.message, remedy=error.remedy)
            self._over(id, kept=False)
            self._leave(press)
            press.answer.set_exception(error)
        except BaseException:
            self._leave(press)
            press.answer.set_exception(DiffuscopeError("the instrument stopped unexpectedly"))
            raise
        finally:
            self.head.light.off()

    def _over(self, id: str, kept: bool, key: str | None = None) -> None:
        """Whatever became of a press, it is under way no longer, nor is what a kill took of its `key`."""
        self.progress.over(id, kept)
        with suppress(StoreError):  # then a restart believes that it was lost, and asks for it again
            self.underway.end(id, key)

    def _leave(self, press: Press) -> None:
        """The press gives its seat to another."""
        with self._turn:
            self._exposing = False
            self._in_the_making -= 1
        self._tell_state()

    def _make(self, shot: Exposed) -> Capture:
        """The rest of the story, which needs no eye."""
        budget_s = self._budget_s()
        try:
            made = self._reconstruct(shot, budget_s)
        except FrameError as error:  # light was spent for it: the shot is kept all the same
            log.warning("no picture could be made of it: %s", error, extra={"code": error.code, "about": shot.id})
            made = unmade(shot.frame, error)
        verdict = self._eyes.judge_again(shot.id, shot.verdict, made.report, shot.press.errand)
        shown = eye_in(made.picture, self.head)
        side = self._eyes.side(shown, verdict, shot.press.errand)
        report = report_of(shot, made.report, verdict, side, budget_s)
        calibration_id = self.head.calibration.id
        capture = Capture(shot.id, shot.press.eye, shot.taken_at, made.simulated, calibration_id, report, {})
        self._tell_stage(shot.press, shot.id, "keep")
        quick = self._quick.get(shot.id)

        def keep() -> Capture:
            files = capture_files(capture, self.head.spec.name, shot.frame, shot.dark, shown, quick)
            return self.store.keep(capture, files, shot.press.errand.beside)

        kept = aside(keep, lambda: self._let_live(shot))
        self.bulletin.tell("kept", id=shot.id)
        took_s = sum(report["seconds"].values())
        log.info("a picture was kept after %.1f s, made by %s", took_s, report["method"], extra={"about": shot.id})
        self.fitness.kept(kept)
        return kept

    def _reconstruct(self, shot: Exposed, budget_s: float) -> Reconstruction:
        def show(stage: Stage) -> None:
            if not stage.last:
                self._show_quick(shot, stage.picture)

        def between() -> None:
            self._watchdog.beat()
            self._let_live(shot)

        self._alive_s = self.clock.now_s()
        return self._reconstructor(
            shot.frame.counts, shot.dark.counts, simulated=shot.frame.simulated,
            deadline=Deadline.after(self.clock, budget_s), watch=show, between=between,
        )  # fmt: skip

    def _let_live(self, shot: Exposed) -> None:
        """Who pressed while a picture is made is let in; else pages hear how far it is, who aims sees a live one."""
        if self._press is not None and not self._closing:
            self._let_in()
        elif self.clock.now_s() - self._alive_s > LIVE_S:
            self._alive_s = self.clock.now_s()
            self.progress.goes_on(shot.press, shot.id)
            if self._alive_s < self._wanted_until_s:
                self._look()

    def _let_in(self) -> None:
        """Who pressed meanwhile is exposed and sees a quick look; then the picture before it goes on."""
        self._answer()
        if self._exposed:
            shot = self._exposed.pop()
            with self._answering(shot.press, shot.id):
                with suppress(FrameError):  # its own turn will say so
                    quick = self._reconstructor(shot.frame.counts, shot.dark.counts, quick=True)
                    self._show_quick(shot, eye_in(quick.picture, self.head))
                self._exposed.append(shot)

    def _show_quick(self, shot: Exposed, image: Image) -> None:
        self._quick[shot.id] = picture.to_jpeg(image, QUICK_PX, shot.frame.simulated)
        self._tell_stage(shot.press, shot.id, "quick", f"/api/captures/{shot.id}/quick.jpg")

    def _look(self) -> None:
        """One live picture; what goes wrong is shown, and tried again a second later."""
        try:
            if (live := self._live_picture()) is None:
                return
        except DiffuscopeError as error:
            self.head.light.off()
            self._report_problem(error)
            self._pause(RETRY_S)
            return
        self._report_problem(None)
        with self._turn:
            self._preview, dark_s = live
            self._turn.notify_all()
        self._pause(2 * dark_s - self._preview.exposed_s - self.clock.now_s())  # as much darkness as there was light

    def _pause(self, duration_s: float) -> None:
        """Do nothing, in the dark, but go on at once when somebody presses."""
        until_s = self.clock.now_s() + duration_s
        while self._press is None and not self._closing and (left_s := until_s - self.clock.now_s()) > 0:
            self.clock.sleep(min(left_s, 0.02))

    def _live_picture(self) -> tuple[Preview, float] | None:
        """The next one, and when its light (for aiming, not the picture's) went off; None if somebody pressed."""
        wanted = self._wanted
        try:
            wanted.permit()
        except Refused:  # the consent was withdrawn since it was asked for
            with self._turn:
                if self._wanted is wanted:  # a newer request goes on
                    self._wanted_until_s = 0.0
            return None
        frame, exposed_s, dark_s = expose_live(self.head, wanted.eyes, self.clock)
        if self._press is not None:
            return None
        deadline = Deadline.after(self.clock, PREVIEW_BUDGET_S)
        made = self._live(frame.counts, simulated=frame.simulated, deadline=deadline, quick=True)
        jpeg = picture.to_jpeg(eye_in(made.picture, self.head), PREVIEW_PX, made.simulated)
        aim = self._eyes.aim(frame.counts, exposed_s)
        return Preview(self._preview.number + 1, jpeg, exposed_s, aim), dark_s

    def _report_problem(self, error: DiffuscopeError | None) -> None:
        before = self.problem.code if self.problem else None
        self.problem = error
        if error is not None and error.code != before:
            log.warning("no live picture: %s", error, extra={"code": error.code})
            self.bulletin.tell("failed", code=error.code, message=error.message, remedy=error.remedy)

    def _tell_state(self) -> None:
        if self.state != self._told:
            self._told = self.state
            self.bulletin.tell("state", state=self._told)
            self._watchdog.status(self._told)

    def _tell_stage(self, press: Press, id: str, stage: str, url: str | None = None) -> None:
        self._watchdog.beat()
        self.progress.stage(press, id, stage, url)
