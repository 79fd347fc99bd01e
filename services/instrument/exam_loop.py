"""Loop of the exam: the one thread that owns the head runs its actions one by one, the most urgent first.

A press has priority: between two solver rounds of a running refinement it is exposed and gets its quick look, then the
refinement resumes. Frames of a press that a kill has interrupted are reconstructed after the presses. Every way out of
an action turns the lamp off.
"""

import logging
import secrets
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial

from device.clock import Clock, Deadline
from device.errors import DiffuscopeError, FrameError, LightFault, StoreError, StoreFull, StoreReadOnly
from device.head import Head
from device.recon.stage import RoundDone, StageResult
from device.values import Reconstruction
from services.errors import Busy, RequestRefused, StoreDamaged, StoreLocked
from services.imaging.raw_metadata import RawMetadata
from services.instrument.background import run_in_thread
from services.instrument.calibration_monitor import CalibrationMonitor
from services.instrument.capture import ExposedCapture, Press, split_notes
from services.instrument.capture_pipeline import CapturePipeline
from services.instrument.exam_events import ExamEvents
from services.instrument.exam_requests import ExamRequests, ExamSnapshot
from services.instrument.exam_state import ExamEvent
from services.instrument.frame_feedback import FAILED_VERDICT
from services.instrument.frame_sink import FrameSink
from services.instrument.live_pictures import LivePictures
from services.instrument.press_exposure import Exposure, colours_of_lamp
from services.instrument.resumption import ResumedPress, resumed_frames
from services.instrument.shutter_button import ShutterButton
from services.instrument.time_budget import within_budget
from services.instrument.watchdog import BEAT_S, Watchdog
from services.records.capture import Capture
from services.records.capture_journal import CaptureJournal
from services.records.capture_store import CaptureStore

log = logging.getLogger(__name__)

LIVE_S = 0.4  # interval of progress events and of live pictures during a refinement
LOCK_PATIENCE_S = 45.0  # for a locked database; the request that finishes a visit waits longer (pending_captures.py)
REFUSALS = (StoreFull, StoreLocked, StoreReadOnly, StoreDamaged)  # of the store: what it refuses can be stored later
AGAIN = "Wait until it is back, then press again."
UNTIL_BACK = "Wait until it is back."
POSTPONED = "The frames of this picture are saved: it is processed at the next start of the instrument."


@dataclass(frozen=True)
class ExamParts:
    """Parts of an exam that its service and its loop share.

    `budget_s` returns the time budget of a picture. `resumed`: presses of the run before, whose frames are on
    the disk.
    """

    head: Head
    store: CaptureStore
    clock: Clock
    watchdog: Watchdog
    budget_s: Callable[[], float]
    requests: ExamRequests
    events: ExamEvents
    button: ShutterButton
    capture_journal: CaptureJournal
    calibration_monitor: CalibrationMonitor
    resumed: tuple[ResumedPress, ...] = ()


class ExamLoop:
    """Loop of the thread `head`, which alone reads and writes its fields and uses the head.

    Each change of the state is an event of `exam_state`; `parts.requests` holds the state.
    """

    def __init__(self, parts: ExamParts, pipeline: CapturePipeline) -> None:
        self._parts = parts
        self._requests = parts.requests
        self._events = parts.events
        self._pipeline = pipeline
        self._live = LivePictures(
            parts.head,
            parts.clock,
            pipeline,
            parts.requests,
            parts.events,
            parts.store.refuse_light_in_vain,
            parts.button,
        )
        self._exposed: deque[ExposedCapture] = deque()
        self._resumed = deque(parts.resumed)
        self._last_update_s = 0.0
        self._free_s = 0.0  # clock seconds at which the last work on another press had ended

    def run(self) -> None:
        """Run actions until the exam closes and every exposed capture is stored."""
        while not (now := self._requests.snapshot).is_closing or self._exposed:
            if not self.step(now):
                self._requests.wait(now, BEAT_S)

    def step(self, now: ExamSnapshot) -> bool:
        """Run the most urgent action in the state `now`; return whether there was one."""
        self._parts.watchdog.beat()
        self._parts.button.poll()
        if now.has_press:
            self._expose_pending()
        elif self._exposed:
            self._complete_oldest()
        elif self._resumed and not now.is_closing:
            self._resume_oldest()
        elif self._parts.calibration_monitor.has_pending and not now.is_closing:
            self._parts.calibration_monitor.step()
        elif self._live.are_wanted:
            self._live.refresh()
        else:
            return False
        return True

    def take_exposed(self) -> dict[str, Press]:
        """Forget the captures that wait for their reconstruction; return their presses by id, for the caller to fail.

        Their frames stay on the disk, for the next start.
        """
        presses = {shot.id: shot.press for shot in self._exposed}
        self._exposed.clear()
        return presses

    def _expose_pending(self) -> None:
        """Expose the waiting press, publish its first verdict and queue the exposure for its reconstruction.

        The frames are dark, lit, and in other colours.

        Consent and space are checked and a journal entry is written before the light; an error fails the press.
        """
        is_first = not self._exposed
        press = self._requests.take_press()
        self._events.state()
        taken_at = self._parts.clock.wall()
        id = Capture.new_id(taken_at, press.eye, secrets.token_hex(3))
        with self._resolving(press, id, ExamEvent.EXPOSURE_FAILED):
            self._exposed.append(self._take(press, id, taken_at))
            # Before the `off` at the exit of this context: if that fails during a refinement, this capture is exposed
            # and waits all the same, and the error fails only the capture whose refinement is suspended.
            self._requests.advance(ExamEvent.EXPOSED)
        if not is_first:
            self._free_s = self._parts.clock.now_s()
        self._events.state()

    def _take(self, press: Press, id: str, taken_at: datetime) -> ExposedCapture:
        head = self._parts.head
        budget_s = self._parts.budget_s()
        target = within_budget(press.target, budget_s)
        target.permit()  # again: the consent may have been withdrawn while the press waited
        self._parts.store.refuse_light_in_vain()
        entry = press.journal_entry(id)
        split = self._pipeline.choose_split(target.frames)
        planned = self._pipeline.exposures(target.frames) * split.parts
        colours = colours_of_lamp(head.spec, target.colours)
        writer = self._parts.capture_journal.begin(entry, press.key, planned, colours)
        shared = RawMetadata(id, press.eye, taken_at, calibration_id=head.calibration.id, head=head.spec.name)
        self._events.stage(press, id, "expose")
        exposure = self._pipeline.expose(
            press.eye,
            in_visit=target.visit is not None,
            count=target.frames,
            split=split,
            colours=colours,
            field=target.field,
            budget_s=budget_s,
            taken=FrameSink(writer, shared, head.spec.light.colour),
            looked=partial(self._events.quick_look, press, id, is_exposing=True),
            permit=target.permit,
        )
        return replace(self._assessed(press, id, taken_at, exposure), written=writer.finish, budget_s=budget_s)

    def _assessed(self, press: Press, id: str, taken_at: datetime, exposure: Exposure) -> ExposedCapture:
        """Return the exposed capture with its first verdict, and publish the verdict."""
        exposure, verdict = self._pipeline.assess(exposure)
        self._events.verdict(id, verdict)
        light = replace(self._parts.head.light.dose_report(), dose_j_per_cm2=exposure.dose_j_per_cm2)
        return ExposedCapture(press, id, taken_at, exposure, light, verdict, notes=split_notes(exposure.split))

    def _resume_oldest(self) -> None:
        """Queue the oldest press of the run before for reconstruction, with the frames that are on the disk."""
        resumed = self._resumed.popleft()
        press = resumed.press
        id = resumed.id
        self._requests.advance(ExamEvent.RESUMED)
        self._events.state()
        with self._resolving(press, id, ExamEvent.FAILED):
            self._exposed.append(self._resume(resumed))
            log.info("an interrupted capture is reconstructed", extra={"about": id})

    def _resume(self, resumed: ResumedPress) -> ExposedCapture:
        press = resumed.press
        id = resumed.id
        journal = self._parts.capture_journal
        try:
            press.target.permit()  # the consent may have been withdrawn since
        except RequestRefused:
            _end_journal_entry(journal, id)
            raise
        journal.count_attempt(id)
        self._events.stage(press, id, "expose")
        frames = resumed_frames(resumed.stored, self._parts.head.calibration, self._parts.clock.now_s())
        exposure = self._pipeline.resume(frames.exposure, press.target.colours)
        shot = self._assessed(press, id, frames.taken_at, exposure)
        return replace(shot, written=lambda: resumed.files, notes=frames.notes, budget_s=self._parts.budget_s())

    def _complete_oldest(self) -> None:
        """Reconstruct and store the oldest exposure, then resolve the future of its press."""
        shot = self._exposed.popleft()
        with self._resolving(shot.press, shot.id, ExamEvent.FAILED):
            kept = self._process(shot)
            _end_journal_entry(self._parts.capture_journal, shot.id, shot.press.key)
            self._events.problem(None)
            self._requests.advance(ExamEvent.STORED)
            self._events.state()
            shot.press.future.set_result(kept)
        self._free_s = self._parts.clock.now_s()
        self._events.forget_quick_look(shot.id)

    @contextmanager
    def _resolving(self, press: Press, id: str, on_error: ExamEvent) -> Iterator[None]:
        """Turn the lamp off at exit; on an error, apply the event `on_error` to the state and fail the press's future.

        A DiffuscopeError is also published on the event bus, and ends the journal entry. Entry and frames stay, so that
        the next start resumes the capture, after a refusal of the store that may end, if a lit frame is on the disk,
        and after an exception of another kind, which is raised again. LightFault if the lamp cannot be turned off.
        """
        try:
            yield
        except DiffuscopeError as raised:
            error = _end_or_postpone(self._parts.capture_journal, id, raised)
            self._events.failed(id, error)
            self._requests.advance(on_error)
            self._events.state()
            press.future.set_exception(error)
        except BaseException:
            self._requests.advance(on_error)
            self._events.state()
            press.future.set_exception(DiffuscopeError("the instrument stopped unexpectedly"))
            raise
        finally:
            self._parts.head.light.off()

    def _process(self, shot: ExposedCapture) -> Capture:
        """Reconstruct, assess and store one exposure; return the stored capture."""
        made, waited_s = self._reconstruct(shot)
        made_s = self._parts.clock.now_s()
        verdict = self._pipeline.reassess(shot, made.report)
        if verdict.code != FAILED_VERDICT.code and (verdict.word, verdict.code) != (
            shot.verdict.word,
            shot.verdict.code,
        ):
            self._events.verdict(shot.id, verdict)  # `make.failed` is shown with the stored capture
        capture, files_of = self._pipeline.record(shot, made, verdict, made_s, waited_s)
        self._events.stage(shot.press, shot.id, "keep")
        target = shot.press.target
        files = files_of()
        deadline = Deadline.after(self._parts.clock, LOCK_PATIENCE_S)
        kept = _when_unlocked(
            lambda: self._parts.store.save(capture, files, target.write_rows, target.request),
            lambda: self._serve_between_rounds(shot),
            lambda: not self._requests.snapshot.is_closing and deadline.left_s() > 0,
            self._events.problem,
        )
        self._events.kept(shot.id)
        text = "a picture was made in %.2f of %g s by %s"
        log.info(text, capture.report.from_read_out_s, shot.budget_s, made.report.method, extra={"about": shot.id})
        self._parts.calibration_monitor.add(kept)
        return kept

    def _reconstruct(self, shot: ExposedCapture) -> tuple[Reconstruction, float]:
        """Run the steps of a reconstruction; publish its quick look, and serve requests between its rounds.

        Return the picture, and the seconds since its last read-out in which the instrument did other work.
        """
        self._last_update_s = self._parts.clock.now_s()
        waited_s = max(0.0, self._free_s - shot.exposure.read_out_s)
        for step in self._pipeline.reconstruct(shot, self._free_s):
            match step:
                case StageResult(last=False):
                    self._events.quick_look(shot.press, shot.id, step.picture, shot.frame.simulated)
                case RoundDone():
                    begin_s = self._parts.clock.now_s()
                    self._parts.watchdog.beat()
                    self._serve_between_rounds(shot)
                    waited_s += self._parts.clock.now_s() - begin_s
                case Reconstruction():
                    made = step
        return made, waited_s

    def _serve_between_rounds(self, shot: ExposedCapture) -> None:
        """Expose a waiting press; else, every LIVE_S, publish the progress of `shot` and take a requested live picture.

        Called between two solver rounds, and every 50 ms while a thread stores the capture. `shot` is not among the
        waiting captures `_exposed` meanwhile.
        """
        if self._requests.snapshot.has_press:
            self._expose_during_refinement()
        elif self._parts.clock.now_s() - self._last_update_s > LIVE_S:
            self._last_update_s = self._parts.clock.now_s()
            self._parts.watchdog.beat()
            self._events.progress(shot.press, shot.id)
            if self._last_update_s < self._requests.snapshot.live_until_s:
                self._live.refresh()

    def _expose_during_refinement(self) -> None:
        """Expose the waiting press and publish its quick look while the running refinement is suspended.

        The exposure stays queued for its own reconstruction, unless it or its quick look has failed.
        """
        self._expose_pending()
        if self._exposed:
            shot = self._exposed.pop()
            with self._resolving(shot.press, shot.id, ExamEvent.FAILED):
                with suppress(FrameError):  # its own reconstruction will report the error
                    look = self._pipeline.quick_look(shot)
                    self._events.quick_look(shot.press, shot.id, look, shot.frame.simulated)
                self._exposed.append(shot)


def _end_journal_entry(journal: CaptureJournal, id: str, key: str | None = None) -> None:
    """Remove a capture from the journal; with `key`, also interrupted captures of that key."""
    with suppress(StoreError):  # then the next start reports the capture as interrupted, or finds it in the store
        journal.end(id, key)


def _end_or_postpone(journal: CaptureJournal, id: str, error: DiffuscopeError) -> DiffuscopeError:
    """Postpone a capture in the journal after a refusal of the store, else end it there; return the error to show.

    The error of a capture that is postponed says so.
    """
    if isinstance(error, REFUSALS):
        return _postponed(journal, id, error)
    with suppress(StoreError):  # then the next start reports the capture as interrupted
        journal.fail(id)
    return error


def _postponed(journal: CaptureJournal, id: str, error: DiffuscopeError) -> DiffuscopeError:
    """Keep the frames of a capture for the next start; return the error, which says so if a lit one is on the disk."""
    is_postponed = False
    with suppress(StoreError, OSError):  # then the next start reports the capture as interrupted
        is_postponed = journal.postpone(id)
    return type(error)(error.message, f"{error.remedy} {POSTPONED}") if is_postponed else error


def _when_unlocked(
    save: Callable[[], Capture],
    keep_alive: Callable[[], None],
    may_wait: Callable[[], bool],
    report: Callable[[StoreLocked], None],
) -> Capture:
    """Run `save` in a thread, and again while another program locks the database and `may_wait`; return the capture.

    The light has been given: the picture waits for the other program. Each attempt waits for the lock as every writer
    does; `report` is called with its error after it, `keep_alive` as in `run_in_thread`.
    """
    while True:
        try:
            return run_in_thread(save, keep_alive)
        except StoreLocked as error:
            if not may_wait():
                raise
            report(error)


def run_exam(
    parts: ExamParts, plan: Callable[[], CapturePipeline], ready: Callable[[], None], on_failure: Callable[[], None]
) -> None:
    """Make the plans, call `ready`, then run the loop; at every exit turn the lamp off and fail the waiting presses.

    After a planning error, a LightFault of the lamp's `off` or an unexpected exception also call `on_failure`, which
    ends the process (restart), unless the exam is being closed.
    """
    failure: DiffuscopeError | None = None
    loop: ExamLoop | None = None
    try:
        parts.watchdog.status("making plans")
        pipeline = plan()
        parts.calibration_monitor.start(pipeline.reconstructor.refractor)
        loop = ExamLoop(parts, pipeline)
        parts.requests.advance(ExamEvent.PLANNED)
        ready()
        parts.watchdog.ready()
        parts.events.state()
        loop.run()
    except DiffuscopeError as error:  # from the planning or the lamp's `off`: other errors fail their press
        failure = error
    finally:
        with suppress(LightFault):  # then the guardian process and the restart of this process turn the lamp off
            parts.head.light.off()
        _fail_waiting(parts, loop)
        parts.capture_journal.close()
        if parts.requests.snapshot.is_closing:
            parts.events.ended(None, failure)
        else:
            parts.events.ended(failure or DiffuscopeError("the instrument stopped unexpectedly"), failure)
            on_failure()


def _fail_waiting(parts: ExamParts, loop: ExamLoop | None) -> None:
    """Fail the futures of all presses that were not completed, with Busy; the frames of exposed ones are kept."""
    pending = parts.requests.end()
    exposed = {resumed.id: resumed.press for resumed in parts.resumed if not resumed.press.future.done()}
    exposed |= loop.take_exposed() if loop is not None else {}
    for id, press in exposed.items():
        ended = Busy("the instrument was switched off before the picture was made", UNTIL_BACK)
        press.future.set_exception(_postponed(parts.capture_journal, id, ended))
    if pending is not None:
        pending.future.set_exception(Busy("the instrument was switched off before the picture was taken", AGAIN))
