"""Record of the exam in virtual time: events and lamp changes of each scenario, and the state after it."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from time import sleep
from typing import Any

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import CameraMissing, DiffuscopeError
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, Eye, Illumination
from services.errors import ConsentDeclined
from services.instrument.events import EventBus
from services.records import digested_json
from services.records.capture_target import CaptureTarget
from tests.golden import compare
from tests.journey.asking import live_picture, with_all_chips
from tests.journey.conftest import SMALL_HEAD, GateClock, Rig, rig_builder, until
from tests.journey.test_exam import FailingCamera

CAPTURE = re.compile(r"\d{8}T\d{6}-(?:OD|OS)-[0-9a-f]{6}")
KEY = "0123456789abcdef"
PATIENCE_S = 150.0  # the first picture may include compilation of the kernels


@dataclass
class Trace:
    """Events and lamp changes in order of occurrence, with virtual times."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    now_s: Callable[[], float] = lambda: 0.0

    def add(self, **entry: Any) -> None:
        """Append one entry at the present virtual time."""
        self.entries.append({"at_s": round(self.now_s(), 6), **entry})


class WatchedWorld(World):
    """A World that appends each change of its lamp to `trace`."""

    trace = Trace()
    _shown: Illumination | None = None

    @property  # type: ignore[override]  # in place of an attribute of World, to see each change
    def illumination(self) -> Illumination | None:
        """Present light of the lamp."""
        return self._shown

    @illumination.setter
    def illumination(self, illumination: Illumination | None) -> None:
        if illumination != self._shown:
            self.trace.add(lamp="dark" if illumination is None else f"{illumination.colour} {illumination.level:g}")
        self._shown = illumination


class ScriptedClock(GateClock):
    """A virtual clock that calls functions at given moments, in the thread that sleeps."""

    def __init__(self) -> None:
        super().__init__()
        self._script: list[tuple[float, Callable[[], Any]]] = []

    def at(self, moment_s: float, act: Callable[[], Any]) -> None:
        """Call `act` when the clock reaches `moment_s`."""
        self._script = sorted([*self._script, (moment_s, act)], key=lambda entry: entry[0])

    @property
    def is_done(self) -> bool:
        """Return whether the whole script has run."""
        return not self._script

    def sleep(self, duration_s: float) -> None:
        """Advance the clock, with a stop at each moment of the script."""
        end_s = self.elapsed_s + max(0.0, duration_s)
        while self._script and self._script[0][0] <= end_s:
            entry = self._script[0]
            super().sleep(entry[0] - self.elapsed_s)
            entry[1]()
            self._script.remove(entry)
        super().sleep(end_s - self.elapsed_s)


def without_figures(kind: str, data: dict[str, Any]) -> dict[str, Any]:
    """Return an event's data without estimated values: FFT plans may change their last digit."""
    match kind:
        case "calibration":
            return {"findings": [{"name": finding["name"], "ok": finding["ok"]} for finding in data["findings"]]}
        case "verdict":
            return data | {"numbers": sorted(data["numbers"])}
        case "aim":
            return {"code": data["code"], "keys": sorted(data)}
    return data


class TracedEventBus(EventBus):
    """An EventBus that appends each event to a trace; `at_quick` is called once, after the first quick look.

    The quick look that is published during the exposure comes at no fixed moment, from the thread of the preparation:
    it is recorded before the verdict, without estimates, and not at all for a press that fails.
    """

    def __init__(self, trace: Trace) -> None:
        super().__init__()
        self._trace = trace
        self._early_look: dict[str, Any] | None = None
        self.at_quick: Callable[[], Any] | None = None

    def publish(self, kind: str, **data: Any) -> None:
        """Record the event, then publish it."""
        recorded = without_figures(kind, data)
        if data.get("stage") == "expose" and data["url"] is not None:
            self._early_look = {key: value for key, value in recorded.items() if key not in ("fraction", "left_s")}
        else:
            look, self._early_look = self._early_look, None
            if kind == "verdict" and look is not None:
                self._trace.add(event="stage", data=look)
            self._trace.add(event=kind, data=recorded)
        super().publish(kind, **data)
        if data.get("stage") == "quick" and self.at_quick is not None:
            act, self.at_quick = self.at_quick, None
            act()


@dataclass
class Stage:
    """One instrument in virtual time, its trace, and the answers to the presses of a scenario."""

    rig: Rig
    clock: ScriptedClock
    trace: Trace
    end: Callable[[], None]
    answers: list[Any] = field(default_factory=list)
    closing: Thread | None = None
    aims_until_s: float = 0.0

    def press(self, eye: Eye, key: str | None = None, target: CaptureTarget | None = None) -> Any:
        """Press, and record the future or the refusal."""
        try:
            pressed = self.rig.exam.press(eye, key, *([target] if target else []))
        except DiffuscopeError as error:
            self.answers.append(refusal(error))
            return None
        self.answers.append(pressed)
        return pressed

    def soon(self, act: Callable[[], Any], after_s: float = 0.15) -> None:
        """Call `act` after a delay, by default during the first lit exposure, which follows the dark one."""
        self.clock.at(self.clock.now_s() + after_s, act)

    def break_(self, *faults: str) -> None:
        """Break parts of the simulated head from now on."""
        self.rig.world.faults.update(faults)

    def add_journal(self) -> None:
        """Append the content of the journal of interrupted captures to the trace."""
        notes = sorted((self.rig.store.folder / "journal").glob("*.json"))
        entries = [digested_json.decoded(path.read_bytes()) for path in notes]  # the digest depends on the id
        self.trace.add(journal=entries)

    def close(self) -> None:
        """Close from another thread, as the server does after SIGTERM; return after the exam has begun to close."""
        self.closing = Thread(target=self.rig.arbiter.close, name="closing", daemon=True)
        self.closing.start()
        assert live_picture(self.rig.exam, 10**9, wait_s=PATIENCE_S) is None  # returns at once during closing

    def settle(self) -> None:
        """Wait until all presses are answered and the exam is idle or has ended."""
        until(lambda: self.clock.is_done, PATIENCE_S)
        for answer in [future for future in self.answers if hasattr(future, "exception")]:
            answer.exception(PATIENCE_S)
        if self.closing is not None:
            self.closing.join(PATIENCE_S)
            return
        until(lambda: self.rig.died.is_set() or rests(self), PATIENCE_S)


def rests(stage: Stage) -> bool:
    """Return whether no press, aim or look is pending."""
    exam, before = stage.rig.exam, stage.clock.now_s()
    if (
        exam.state != "aim"
        or exam.calibration_monitor.has_pending
        or stage.rig.world.illumination is not None
        or before < stage.aims_until_s
    ):
        return False
    sleep(0.1)
    return exam.state == "aim" and not exam.calibration_monitor.has_pending and stage.clock.now_s() == before


def refusal(error: BaseException) -> dict[str, Any]:
    """Return an error as a record."""
    assert isinstance(error, DiffuscopeError), error
    return {"code": error.code, "message": error.message, "remedy": error.remedy}


# Scenarios


def press(stage: Stage) -> None:
    """One press of the right eye; while it is exposed, the journal of interrupted captures names it."""
    stage.soon(stage.add_journal)
    stage.press("OD", KEY)


def press_while_aiming(stage: Stage) -> None:
    """Live pictures in red, then a press after one second of them."""
    stage.soon(lambda: stage.press("OS"), 1.0)
    assert live_picture(stage.rig.exam, 0, wait_s=PATIENCE_S) is not None


def aiming_ends(stage: Stage) -> None:
    """Live pictures go on for as long as they are wanted, and end by themselves."""
    stage.aims_until_s = 3.09  # within the pause after the last one
    assert live_picture(stage.rig.exam, 0, wait_s=PATIENCE_S) is not None


def press_during_refinement(stage: Stage) -> None:
    """A second press at the first quick look; a third one is refused."""

    def more() -> None:
        stage.press("OS")
        stage.press("OD")

    bulletin = stage.rig.event_bus
    assert isinstance(bulletin, TracedEventBus)
    bulletin.at_quick = more
    stage.press("OD")


def repeated_press(stage: Stage) -> None:
    """The same key in the midst of the exposure is the same picture; the key for the other eye is refused."""

    def again() -> None:
        stage.press("OD", KEY)
        stage.press("OS", KEY)
        stage.press("OD")

    stage.soon(again)
    stage.press("OD", KEY)


def cancel(stage: Stage) -> None:
    """A page that goes away cancels nothing: the picture is kept."""
    pressed = stage.press("OD")
    stage.answers.append({"cancelled": pressed.cancel()})


def withdrawn(stage: Stage) -> None:
    """The consent is withdrawn between the press and its light: no light."""

    def permit() -> None:
        raise ConsentDeclined("PR 1 did not agree to pictures")

    stage.press("OD", None, CaptureTarget(visit="v", slot="R-centre", permit=permit))


def camera_lost(stage: Stage) -> None:
    """The camera is gone in the midst of the lit exposure, and back for the next press."""
    stage.soon(lambda: stage.break_("camera.missing"))
    stage.press("OD")
    stage.settle()
    stage.rig.world.faults.clear()
    stage.press("OD")


def camera_stalled(stage: Stage) -> None:
    """The lit frame never comes."""
    stage.soon(lambda: stage.break_("camera.stalled"))
    stage.press("OD")


def camera_pulled(stage: Stage) -> None:
    """The driver raises while the lamp is lit."""
    stage.press("OD")


def light_fault(stage: Stage) -> None:
    """The lamp does not light up."""
    stage.break_("light.fault")
    stage.press("OD")


def light_cut(stage: Stage) -> None:
    """The exposure hangs; the guard's timer ends the light."""
    stage.soon(lambda: until(lambda: stage.rig.world.illumination is None))
    stage.press("OD")


def sigterm_during_exposure(stage: Stage) -> None:
    """SIGTERM in the midst of the lit exposure: the picture is finished and kept."""
    stage.soon(stage.close)
    stage.press("OD")


def sigterm_while_aiming(stage: Stage) -> None:
    """SIGTERM in the midst of a live picture."""
    stage.soon(stage.close, 0.02)
    live_picture(stage.rig.exam, 0, wait_s=PATIENCE_S)


def head_lost(stage: Stage) -> None:
    """Camera, chips and lamp are gone in the midst of the lit exposure; the next press fails at once."""
    stage.soon(lambda: stage.break_("camera.missing", "bus.silent", "light.fault"))
    stage.press("OD")
    stage.settle()
    stage.press("OS")


def lamp_lost(stage: Stage) -> None:
    """The lamp cannot be switched off any more: the exam ends the process."""
    stage.soon(lambda: stage.break_("light.silent"))
    stage.press("OD")


SCENARIOS: dict[str, Callable[[Stage], None]] = {
    scenario.__name__: scenario
    for scenario in (
        press,
        press_while_aiming,
        aiming_ends,
        press_during_refinement,
        repeated_press,
        cancel,
        withdrawn,
        camera_lost,
        camera_stalled,
        camera_pulled,
        light_fault,
        light_cut,
        sigterm_during_exposure,
        sigterm_while_aiming,
        head_lost,
        lamp_lost,
    )
}
LIMITS = {"light_cut": {"max_on_s": 0.15}}  # other arguments of the instrument


@contextmanager
def instruments() -> Iterator[Callable[[str], Stage]]:
    """Yield a function that builds the instrument of a scenario; all share the traced light and the FFT plans."""
    with TemporaryDirectory() as place, ExitStack() as undo:
        folder = Path(place)
        (folder / "small.toml").write_text(SMALL_HEAD)
        world, calibration = watched(load_head(folder / "small.toml"))

        def built(name: str) -> Stage:
            trace, clock = Trace(), ScriptedClock()
            trace.now_s = clock.now_s
            options: dict[str, Any] = {"head": with_all_chips, "event_bus": TracedEventBus(trace), "clock": clock}
            pulled = Event()
            if name == "camera_pulled":
                pulled.set()
                del options["head"]  # its chips belong to the world of a simulated camera
                options["camera"] = lambda camera: FailingCamera(camera, pulled, CameraMissing("the cable is out"))
            build = rig_builder((world, calibration), folder / "plans")
            own = undo.enter_context(ExitStack())
            rig = build(folder / name, own, **options, **LIMITS.get(name, {}))
            own.callback(rig.world.faults.clear)
            assert isinstance(rig.world, WatchedWorld)
            rig.world.trace = trace  # the lamp was dark until now
            return Stage(rig, clock, trace, own.close)

        yield built


def watched(spec: InstrumentSpec) -> tuple[World, Calibration]:
    """Return a coarse world of the head with its light already traced, and its calibration."""
    coarse = {"rows": 135, "cols": 240, "pitch_um": 2 * spec.camera.pitch_um}
    world = WatchedWorld(spec.model_copy(update={"camera": spec.camera.model_copy(update=coarse)}), VirtualClock())
    for colour in (spec.light.colour, spec.light.preview_colour):
        world.electrons_per_s(colour)
    return world, simulated_calibration(world)


def play(stage: Stage, name: str) -> dict[str, Any]:
    """Run one scenario and return its trace and final state; captures are named by their order."""
    until(lambda: bool(stage.trace.entries), PATIENCE_S)  # first state event, shortly after the exam is ready
    SCENARIOS[name](stage)
    stage.settle()
    rig = stage.rig
    found = {
        "what": SCENARIOS[name].__doc__,
        "trace": stage.trace.entries,
        "answers": [answered(answer) for answer in stage.answers],
        "after": {
            "state": rig.exam.state,
            "problem": None if rig.exam.problem is None else refusal(rig.exam.problem),
            "died": rig.died.is_set(),
            "lamp": "dark" if rig.world.illumination is None else "lit",
            "captures": [
                [capture.id, capture.eye, capture.simulated, sorted(capture.files)] for capture in rig.store.captures()
            ],
            "journal": sorted(path.name for path in (rig.store.folder / "journal").iterdir()),
            "spent_j_per_cm2": {
                eye: float(f"{rig.exam.head.light.ledger.spent_j_per_cm2(eye):.6g}") for eye in ("OD", "OS")
            },
        },
    }
    played = numbered(found)
    stage.end()
    return played


def answered(answer: Any) -> Any:
    """Return the answer to a press: the capture's name, or the refusal."""
    if isinstance(answer, dict):
        return answer
    error = answer.exception(0)
    return answer.result().id if error is None else refusal(error)


def numbered(value: Any) -> Any:
    """Return the value with names of captures replaced in order of first appearance."""
    text = json.dumps(value)
    for number, name in enumerate(dict.fromkeys(CAPTURE.findall(text)), 1):
        text = text.replace(name, f"capture-{number}")
    return json.loads(text)


def write() -> Path:
    """Write the record of all scenarios."""
    with instruments() as built:
        compare.write("exam", {name: play(built(name), name) for name in SCENARIOS})
    return compare.RECORDS / "exam.json"
