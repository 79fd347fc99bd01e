"""Random sequences of presses, faults and signals on the exam loop in virtual time, and the rules that hold for each.

python -m tests.property.exam_sequences [N]     run N sequences (10 000 by default) and print the number of violations

The loop, its requests, events, head, guard, store and journal are those of the instrument; the head is simulated, with
a small sensor. Only the reconstruction is a stand-in: a generator of the same steps with small arrays. One thread runs
everything; an action happens while the clock sleeps (in an exposure, a round or a pause), at an event, or while the
loop is idle.
"""

import asyncio
import logging
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from device.clock import Deadline, VirtualClock
from device.config.head_file import load_head
from device.errors import DiffuscopeError, FrameError
from device.head import Head, hazard_of
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.ports import Camera
from device.recon.assessment.aiming import Aim
from device.recon.assessment.laterality import Laterality
from device.recon.model.kernels import Pixels
from device.recon.stage import ROUND_DONE, Recipe, StageResult, Step
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import (
    Calibration,
    ExposureSettings,
    Eye,
    Frame,
    Illumination,
    Image,
    Reconstruction,
    Report,
    Verdict,
)
from services.errors import Busy, ConsentDeclined
from services.http.control_lease import ControlLease
from services.imaging.picture_files import read_raw_tiff
from services.instrument.calibration_monitor import CalibrationMonitor
from services.instrument.capture import LiveRequest, Press
from services.instrument.capture_pipeline import CapturePipeline
from services.instrument.events import EventBus
from services.instrument.exam_events import ExamEvents
from services.instrument.exam_loop import REFUSALS, ExamParts, run_exam
from services.instrument.exam_requests import ExamRequests, ExamSnapshot
from services.instrument.exam_state import ExamState
from services.instrument.frame_feedback import NO_AIM
from services.instrument.progress import Progress
from services.instrument.resumption import resumed_presses
from services.instrument.shutter_button import ShutterButton
from services.instrument.watchdog import Watchdog
from services.records.capture import Capture
from services.records.capture_journal import CaptureJournal
from services.records.capture_store import CaptureStore
from services.records.capture_target import CaptureTarget
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository
from tests.journey.conftest import SMALL_HEAD

ROUNDS, ROUND_S, BUDGET_S = 4, 0.3, 5.0
SEQUENCES_PER_STORE = 25  # a start of the exam reads the latest captures
EXPOSING = (ExamState.EXPOSING, ExamState.MAKING_EXPOSING)
TINY = {"rows": 34, "cols": 60, "pitch_um": 161.28}
FAULTS = (
    ("camera.missing",),
    ("camera.stalled",),
    ("light.fault",),
    ("light.silent",),
    ("eye.closed",),
    ("camera.missing", "bus.silent", "light.fault"),  # the head is lost
)
TRIGGERS = ("time", "idle", "state", "stage", "verdict", "kept", "failed")
ACTIONS = (
    "press",
    "repeat",
    "cancel",
    "take lease",
    "release lease",
    "fault",
    "repair",
    "disk",
    "consent",
    "aim",
    "useless frames",
    "unexpected",
    "kill",
    "close",
)


@dataclass(frozen=True)
class Action:
    """One action, when it happens (`trigger`; `delay_s` after the previous one for "time"), and its choices."""

    trigger: str
    delay_s: float
    name: str
    eye: Eye
    screen: str | None
    choice: int


SEQUENCE = st.lists(
    st.builds(
        Action,
        st.sampled_from(TRIGGERS),
        st.sampled_from([0.0, 0.01, 0.05, 0.15, 0.35, 0.6, 1.3, 3.5, 40.0]),
        st.sampled_from([*ACTIONS, "press", "press", "press", "repair", "aim"]),
        st.sampled_from(["OD", "OS"]),
        st.sampled_from([None, "A", "A", "B"]),
        st.integers(0, len(FAULTS) - 1),
    ),
    min_size=1,
    max_size=14,
)


class Unexpected(RuntimeError):
    """Exception of the camera, or at any moment, that the exam does not know: it ends the process."""


@dataclass
class Conditions:
    """What the actions change around the exam."""

    has_consent: bool = True
    is_disk_full: bool = False
    is_camera_broken: bool = False
    is_killed: bool = False
    is_frame_useless: bool = False


class BreakableCamera:
    """Camera that raises an unknown exception while its condition is set; `on_frame` is called with each frame."""

    def __init__(self, camera: Camera, conditions: Conditions, on_frame: Callable[[Frame], None]) -> None:
        self._camera, self._conditions, self.shape, self._on_frame = camera, conditions, camera.shape, on_frame

    def prepare(self, shot: ExposureSettings) -> None:
        self._camera.prepare(shot)

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        frame = self._camera.expose(shot, into)
        if self._conditions.is_camera_broken:
            raise Unexpected("the camera driver failed")
        self._on_frame(frame)
        return frame

    def close(self) -> None:
        self._camera.close()


class ScriptedClock(VirtualClock):
    """Virtual clock that calls `act` at each moment that it is set for, in the thread that sleeps.

    `die` is called at the end of each sleep, and raises the exception that ends the process, if it is to end.
    """

    def __init__(self) -> None:
        super().__init__()
        self.alarm_s: float | None = None
        self.act: Callable[[], None] = lambda: None
        self.die: Callable[[], None] = lambda: None

    def sleep(self, duration_s: float) -> None:
        end_s = self.elapsed_s + max(0.0, duration_s)
        while self.alarm_s is not None and self.alarm_s <= end_s:
            super().sleep(self.alarm_s - self.elapsed_s)
            self.act()
        super().sleep(end_s - self.elapsed_s)
        self.die()


class WatchedWorld(World):
    """A World that calls `on_light` whenever its lamp goes on."""

    on_light: Callable[[Illumination], None]
    _shown: Illumination | None = None

    @property  # type: ignore[override]  # in place of an attribute of World, to see each change
    def illumination(self) -> Illumination | None:
        return self._shown

    @illumination.setter
    def illumination(self, illumination: Illumination | None) -> None:
        self._shown = illumination
        if illumination is not None:
            self.on_light(illumination)


class HookedBus(EventBus):
    """Event bus that calls `hook` with the kind of each event after its publication."""

    hook: Callable[[str], None]

    def publish(self, kind: str, **data: Any) -> None:
        super().publish(kind, **data)
        self.hook(kind)


class VirtualRequests(ExamRequests):
    """Requests whose idle wait calls `idle` instead of waiting in real time."""

    idle: Callable[[], None]

    def wait(self, seen: ExamSnapshot, timeout_s: float) -> None:
        if self.snapshot is seen:
            self.idle()


class TinyReconstructor:
    """Reconstruction stand-in: the steps of two stages with small arrays, ROUND_S of virtual time for each round."""

    refractor = None

    def __init__(self, clock: VirtualClock, conditions: Conditions) -> None:
        self._clock, self._conditions = clock, conditions

    def steps(
        self, counts: Pixels, dark: Pixels | None = None, *, simulated: bool, deadline: Deadline | None = None
    ) -> Iterator[Step]:
        if self._conditions.is_frame_useless:
            raise FrameError("too many pixels are missing")
        yield StageResult(Recipe("gradient", 4), _picture(counts)[::4, ::4], last=False)
        for _ in range(ROUNDS):
            self._clock.sleep(ROUND_S)
            yield ROUND_DONE
        yield StageResult(Recipe("gradient", 1), _picture(counts), last=True)
        yield Reconstruction(_picture(counts), Report("gradient", rounds=ROUNDS), simulated)

    def __call__(
        self,
        counts: Pixels,
        dark: Pixels | None = None,
        *,
        simulated: bool = False,
        deadline: Deadline | None = None,
        quick: bool = False,
    ) -> Reconstruction:
        if self._conditions.is_frame_useless:
            raise FrameError("too many pixels are missing")
        self._clock.sleep(0.02)
        return Reconstruction(_picture(counts), Report("gradient", rounds=0), simulated)


def _picture(counts: Pixels) -> Image:
    return np.asarray(counts, np.float32)


class PlainFeedback:
    """Assessment stand-in: every frame is good."""

    def aim(self, counts: Pixels, exposed_s: float) -> Aim:
        return NO_AIM

    def speed_deg_per_s(self, now_s: float) -> float | None:
        return None

    def assess(self, counts: Pixels, dark: Pixels, begin_s: float) -> Verdict:
        return Verdict("good", None, {})

    def reassess(self, first: Verdict, report: Report, target: CaptureTarget) -> Verdict:
        return first

    def estimate_laterality(self, picture: Image, verdict: Verdict, target: CaptureTarget) -> Laterality | None:
        return None


@dataclass
class Bench:
    """Parts that many sequences share: a world with its light already computed, a calibration, a store."""

    world: WatchedWorld
    calibration: Calibration
    store: CaptureStore
    visit: str
    conditions: Conditions
    number: int = 0


class Run:
    """One sequence on one exam: performs the actions and collects the violations of the rules."""

    def __init__(self, bench: Bench, actions: list[Action]) -> None:
        self.bench, self.script = bench, list(actions)
        self.violations: list[str] = []
        self.conditions = bench.conditions
        self.futures: list[Future[Capture]] = []
        self.resumed: list[Future[Capture]] = []  # of the run before, whose frames are on the disk
        self.lit: list[Future[Capture]] = []  # of which a lit frame was taken
        self.done: Counter[str] = Counter()
        self.died = False
        self.clock, self.event_bus = ScriptedClock(), HookedBus()
        self.world = copy(bench.world)
        self.world.clock, self.world.faults, self.world.on_light = self.clock, set(), self._check_light
        self.lease, self.requests = ControlLease(self.clock), VirtualRequests(self.clock)
        self.clock.die = self._end_if_killed
        self.clock.act, self.event_bus.hook, self.requests.idle = self._act_now, self._act_at_event, self._act_idle
        self._is_acting = self._is_permitted = False
        self.parts = self._parts()

    def _parts(self) -> ExamParts:
        bench, clock, watchdog = self.bench, self.clock, Watchdog(None)
        bench.number += 1
        sensor = replace(bench.calibration.sensor, read_noise_e=1.0 + 1e-6 * bench.number)
        calibration = replace(bench.calibration, sensor=sensor)  # the monitor checks own captures
        spec = self.world.spec
        light = GuardedLight(SimLight(self.world), clock, 30.0, hazard_of(spec), MemoryLedger(clock))
        camera = BreakableCamera(SimCamera(self.world), self.conditions, self._count_frame)
        head = Head(spec, camera, light, calibration, present_eye=self.world.present_eye)
        progress = Progress(clock, 2 * spec.camera.exposure_s, lambda: BUDGET_S)
        monitor = CalibrationMonitor(
            head, bench.store, self.event_bus, clock, lambda: self.requests.snapshot.is_interrupted, watchdog
        )
        journal = CaptureJournal(bench.store)
        resumed = resumed_presses(
            journal, lambda capture: CaptureTarget(capture.press.visit, capture.press.slot, permit=self._permit_resumed)
        )
        self.resumed = [entry.press.future for entry in resumed]
        return ExamParts(
            head,
            bench.store,
            clock,
            watchdog,
            lambda: BUDGET_S,
            self.requests,
            ExamEvents(self.event_bus, watchdog, progress, self.requests),
            ShutterButton(head.button, self.event_bus),
            journal,
            monitor,
            resumed,
        )

    def play(self) -> None:
        """Run the exam until it has ended, and check the rules for its end."""
        self._arm()
        reconstructor = TinyReconstructor(self.clock, self.conditions)

        def plan() -> CapturePipeline:
            self.clock.sleep(0.5)
            return CapturePipeline(self.parts.head, self.clock, reconstructor, reconstructor, PlainFeedback())

        try:
            run_exam(self.parts, plan, lambda: None, self._die)
        except Unexpected:
            self._require(self.conditions.is_camera_broken or self.conditions.is_killed, "an exception without a cause")
        self._check_end()

    def _die(self) -> None:
        self.died = True

    def _end_if_killed(self) -> None:
        if self.conditions.is_killed:
            raise Unexpected("the process ends")

    def _count_frame(self, frame: Frame) -> None:
        if frame.illumination is not None and self.requests.snapshot.state in EXPOSING:
            self.lit.append(self.futures[-1])

    def _require(self, holds: bool, rule: str) -> None:
        if not holds:
            self.violations.append(
                f"{rule} (state {self.requests.snapshot.state.name}, t {self.clock.elapsed_s:.3f} s)"
            )

    # Rules

    def _check_light(self, illumination: Illumination) -> None:
        now = self.requests.snapshot
        if illumination.colour == self.world.spec.light.colour:
            self._require(now.state in EXPOSING, "light of a capture outside its exposure")
            self._require(self._is_permitted, "light of a capture whose consent was not read")
            self._is_permitted = False
        else:
            self._require(self._is_permitted, "aiming light without a request, or its consent was not read")
            self._is_permitted = False
            self._require(now.state is not ExamState.STARTING, "aiming light before the plans are made")

    def _check_rest(self) -> None:
        """Check the rules that hold between two actions of the loop."""
        if "light.silent" not in self.world.faults:
            self._require(self.world.illumination is None, "the lamp is on between two actions")
        pending = sum(not future.done() for future in self.futures)
        self._require(pending == self.requests.snapshot.state.captures, f"{pending} presses are not answered")
        self._require(
            all(future.done() for future in self.resumed), "an interrupted press waits although there is time"
        )

    def _check_end(self) -> None:
        now, store = self.requests.snapshot, self.bench.store
        self._require(now.state is ExamState.ENDED, "the exam has not ended")
        self._require(self.died or now.is_closing, "the end was not reported")
        self.world.faults.discard("light.silent")
        if self.world.illumination is not None:  # no command reached the lamp: the guardian process turns it off
            self._require(self.died or now.is_closing, "the lamp stays on and the process too")
            self.parts.head.light.off()
        self._require(self.world.illumination is None, "the lamp is on at the end")
        for future in (*self.futures, *self.resumed):
            self._require(future.done(), "a press is never answered")
            error = future.exception(0) if future.done() else None
            self._require(error is None or isinstance(error, DiffuscopeError), f"a press fails with {error!r}")
            if future.done() and error is None:
                self._check_stored(future.result(0), store)
        self.done["stored"] += sum(future.done() and future.exception(0) is None for future in self.futures)
        self.done["resumed"] += sum(future.done() and future.exception(0) is None for future in self.resumed)
        left = sum(is_left_for_later(future) for future in (*self.lit, *self.resumed))
        on_disk = len(list(store.folder.glob("journal/*/raw.tiff.json")))
        self._require(on_disk == left, f"{on_disk} presses have frames on the disk, and {left} were left for later")

    def _check_stored(self, capture: Capture, store: CaptureStore) -> None:
        self._require(store.get(capture.id) == capture, "an acknowledged capture is not stored as it was answered")
        raw, _ = read_raw_tiff(store.read(capture.id, "raw.tiff"))
        self._require(raw.shape == self.world.shape, "the raw frame of a capture cannot be read")
        self._require(capture.simulated, "a capture is not marked as simulated")
        journal = store.folder / "journal" / f"{capture.id}.json"
        self._require(not journal.exists(), "a stored capture is still in the journal")
        self._require(not journal.with_suffix("").exists(), "frames of a stored capture are still in the journal")

    # Actions

    def _arm(self) -> None:
        """Set the clock for the next action, if it waits for a time."""
        is_timed = bool(self.script) and self.script[0].trigger == "time"
        self.clock.alarm_s = self.clock.elapsed_s + self.script[0].delay_s if is_timed else None

    def _act_now(self) -> None:
        """Perform the next action."""
        if self._is_acting or not self.script:
            self.clock.alarm_s = None
            return
        self._is_acting = True
        action = self.script.pop(0)
        self.clock.alarm_s = None
        self.done[action.name] += 1
        self._perform(action)
        self._is_acting = False
        self._arm()

    def _act_at_event(self, kind: str) -> None:
        if self.script and self.script[0].trigger == kind:
            self._act_now()

    def _act_idle(self) -> None:
        """Perform the next action of an idle exam, whatever it waits for; without one, close the exam."""
        self._check_rest()
        if self.script and self.script[0].trigger == "time" and self.clock.alarm_s is not None:
            self.clock.sleep(self.clock.alarm_s - self.clock.elapsed_s)
        elif self.script:
            self._act_now()
        else:
            self.requests.close()

    def _perform(self, action: Action) -> None:
        match action.name:
            case "press":
                self._press(action, None)
            case "repeat":
                self._press(action, f"{action.choice % 2:016x}")
            case "cancel":
                for future in self.futures:
                    self._require(not future.cancel(), "a page has cancelled a capture")
            case "take lease":
                self.lease.acquire(action.screen or "A", take=True)
            case "release lease":
                self.lease.release(action.screen or "A")
            case "aim":
                asyncio.run(self.requests.preview(10**9, 0.0, LiveRequest((action.eye,), self._permit)))
            case "close":
                self.requests.close()
            case _:
                self._change_conditions(action)

    def _change_conditions(self, action: Action) -> None:
        match action.name:
            case "fault":
                self.world.faults.update(FAULTS[action.choice])
            case "repair":
                self.world.faults.clear()
                self.conditions.is_disk_full = self.conditions.is_frame_useless = False
                self.conditions.has_consent = True
            case "disk":
                self.conditions.is_disk_full = True
            case "consent":
                self.conditions.has_consent = not self.conditions.has_consent
            case "useless frames":
                self.conditions.is_frame_useless = True
            case "unexpected":
                self.conditions.is_camera_broken = True
            case "kill":
                self.conditions.is_killed = True

    def _permit_resumed(self) -> None:
        if not self.conditions.has_consent:
            raise ConsentDeclined("the patient did not agree to pictures")

    def _permit(self) -> None:
        if not self.conditions.has_consent:
            raise ConsentDeclined("the patient did not agree to pictures")
        self._is_permitted = True

    def _press(self, action: Action, key: str | None) -> None:
        """Press as the endpoint does it: the control lease is required first, then the exam accepts or refuses."""
        before = self.requests.snapshot
        future: Future[Capture] = Future()
        future.set_running_or_notify_cancel()
        target = CaptureTarget(visit=self.bench.visit, slot=f"{action.eye}-centre", permit=self._permit)
        try:
            self.lease.acquire_or_refuse(action.screen)
            accepted = self.requests.press(Press(future, action.eye, target, key), None)
        except DiffuscopeError as error:
            if isinstance(error, Busy) and type(error) is Busy:
                refusing = before.is_closing or not before.state.accepts_press
                self._require(refusing, "a press is refused without a reason")
            return
        if accepted is not future:
            self._require(accepted in self.futures, "a key gives an unknown capture")
            return
        self.done["accepted"] += 1
        self.futures.append(future)
        self._require(before.state.accepts_press and not before.is_closing, "a press is accepted that must be refused")


def is_left_for_later(future: Future[Capture]) -> bool:
    """Return whether a press ended with the exam, or was refused by the store: its frames stay on the disk."""
    error = future.exception(0) if future.done() else None
    return error is not None and (isinstance(error, (Busy, *REFUSALS)) or "stopped unexpectedly" in str(error))


@dataclass
class Sequences:
    """Runs sequences on a bench that it opens again from time to time."""

    folder: Path
    undo: ExitStack = field(default_factory=ExitStack)
    bench: Bench | None = None
    count: int = 0
    done: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    template: tuple[WatchedWorld, Calibration] | None = None

    def play(self, actions: list[Action]) -> list[str]:
        """Run one sequence; return its violations."""
        if self.count % SEQUENCES_PER_STORE == 0:
            self.bench = self._opened()
        assert self.bench is not None
        self.count += 1
        conditions = self.bench.conditions
        for name, value in vars(Conditions()).items():
            setattr(conditions, name, value)
        run = Run(self.bench, actions)
        run.play()
        self.done.update(run.done)
        self.violations.extend(run.violations)
        return run.violations

    def _opened(self) -> Bench:
        if self.template is None:
            (self.folder / "small.toml").write_text(SMALL_HEAD.replace("haemorrhages = 3", 'kind = "point"'))
            spec = load_head(self.folder / "small.toml")
            spec = spec.model_copy(update={"camera": spec.camera.model_copy(update=TINY)})
            world = WatchedWorld(spec, VirtualClock())
            for colour in (spec.light.colour, spec.light.preview_colour):
                for eye in ("OD", "OS"):
                    world.eye = eye
                    world.electrons_per_s(colour)
            self.template = world, simulated_calibration(world)
        self.undo.close()
        conditions = Conditions()
        store = self.undo.enter_context(
            CaptureStore(
                self.folder / f"store-{self.count}",
                reserve_bytes=0,
                free_bytes=lambda _: 0 if conditions.is_disk_full else 10**9,
            )
        )
        programme = load_programme()
        visit = VisitRepository(store.engine, programme, VirtualClock()).begin("0" * 16).id
        return Bench(*self.template, store, visit, conditions)


@contextmanager
def sequences() -> Iterator[Sequences]:
    """Yield a runner of sequences in a temporary folder."""
    with TemporaryDirectory(prefix="exam") as place:
        runner = Sequences(Path(place))
        with runner.undo:
            yield runner


def run(count: int) -> Sequences:
    """Run `count` random sequences; raise AssertionError at the first violation, with the smallest sequence found."""
    with sequences() as runner:

        @settings(
            max_examples=count,
            deadline=None,
            database=None,
            print_blob=False,
            phases=(Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
        )
        @given(SEQUENCE)
        def play(actions: list[Action]) -> None:
            violations = runner.play(actions)
            assert not violations, "\n".join(violations)

        play()
    return runner


def main() -> int:
    """Run the sequences and print the figures."""
    logging.disable(logging.WARNING)  # each injected fault is logged
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    begin_s = time.monotonic()
    runner = run(count)
    took_s = time.monotonic() - begin_s
    sys.stdout.write(f"{runner.count} sequences in {took_s:.0f} s, {len(runner.violations)} violations\n")
    sys.stdout.write(", ".join(f"{name} {number}" for name, number in sorted(runner.done.items())) + "\n")
    return int(bool(runner.violations))


if __name__ == "__main__":
    sys.exit(main())
