"""Contract of a run with trial lenses: lenses in order, refusals, failed measurements, stops, and what is stored."""

from collections.abc import Callable, Iterator
from copy import copy
from functools import partial
from pathlib import Path
from threading import Event

import pytest

from device.calibration.archive import Archive
from device.calibration.trial_lenses import TRIAL_LENSES, LensReading
from device.config.head_file import load_head
from device.errors import CalibrationRefused, CameraMissing, DiffuscopeError
from device.head import Head, hazard_of
from device.light_safety.dose_ledger import MemoryLedger
from device.light_safety.guard import GuardedLight
from device.optics.trial_lens import PowerVector, TrialLens
from device.ports import Chips
from device.sim.camera import SimCamera
from device.sim.chips import SimHeadMemory
from device.sim.light import SimLight
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Calibration, ExposureSettings, HeadIdentity, Illumination
from services.errors import Busy
from services.instrument.guided_run import RunOutcome, RunParts, RunState
from services.instrument.trial_lens_measurement import LensBench, LensCheck, TrialLensOutcome
from services.instrument.trial_lens_run import TrialLensRequest, TrialLensSession
from services.instrument.watchdog import Watchdog
from tests.journey.conftest import GateClock, until
from tests.simulated import small_head_toml, world
from tests.unit.test_trial_lenses import WHO, readings

LensState = RunState[int, LensReading, TrialLensRequest]
POINT = '[sim]\n\n[sim.object]\nkind = "point"\n'  # no vessels to simulate


class KnownCheck(LensCheck):
    """Measurement that takes a lit frame with each lens, and then has known readings, or raises `failing`."""

    def __init__(self, head: Head, archive: Archive, bench: LensBench, known: dict[TrialLens, LensReading]) -> None:
        super().__init__(head, archive, bench)
        self.head, self.known, self.failing = head, known, list[Exception]()

    def read(self, lens: TrialLens) -> LensReading:
        with self.head.light.on(Illumination("green")):
            self.head.camera.expose(ExposureSettings(0.1))
        if self.failing:
            raise self.failing.pop()
        return self.known[lens]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[World, Calibration]:
    path = tmp_path_factory.mktemp("head") / "head.toml"
    path.write_text(small_head_toml("Trial", POINT, summed=2))
    traced = world(load_head(path))
    return traced, simulated_calibration(traced)


class Run:
    """Run on a simulated head with a calibration in force in `archive`; `stop` ends it."""

    def __init__(self, of: World, calibration: Calibration, folder: Path, off: PowerVector) -> None:
        self.clock, self.archive, self.done = GateClock(), Archive(folder), Event()
        self.clock.world = self.world = copy(of)
        self.world.clock, self.world.faults = self.clock, set()
        self.archive.add_and_activate(calibration, WHO)
        self.before, self.outcomes, self.checks = (
            self.archive.active_id(),
            list[RunOutcome](),
            list[KnownCheck](),
        )
        self.known = {reading.lens: reading for reading in readings(off)}
        light = GuardedLight(SimLight(self.world), self.clock, 1.0, hazard_of(of.spec), MemoryLedger(self.clock))
        self.placed: list[tuple[TrialLens, float]] = []
        self.head = Head(
            of.spec,
            SimCamera(self.world),
            light,
            calibration,
            Chips(memory=SimHeadMemory(self.world)),
            place_trial_lens=lambda lens, mm: self.placed.append((lens, mm)),
        )
        parts = RunParts(of.spec, self.archive, self.clock, Watchdog(None), self.no_bench, lambda: self.head)
        self.session = TrialLensSession(parts, TrialLensRequest(LensBench()), self.end, self.measure)

    def measure(self, head: Head, archive: Archive, bench: LensBench) -> LensCheck:
        self.checks.append(KnownCheck(head, archive, bench, self.known))
        return self.checks[0]

    def no_bench(self) -> None:
        raise AssertionError("a head without its calibration measures no refraction")

    def end(self, outcome: RunOutcome) -> None:
        self.outcomes.append(outcome)
        self.done.set()

    @property
    def now(self) -> LensState:
        return self.session.run.now

    def asked(self, lens: int) -> LensState:
        """Wait until this lens is asked for; return the state."""
        until(lambda: (self.now.state, self.now.step) == ("asking", lens) or self.done.is_set())
        assert not self.done.is_set(), self.outcomes
        return self.now

    def has_asked_again(self, error: DiffuscopeError) -> bool:
        """Return whether the last measurement failed with this error, and its lens is asked for."""
        return self.now.error is error and self.now.state == "asking"

    def show(self, *lenses: int) -> None:
        for lens in lenses:
            self.asked(lens)
            self.session.ready(lens)

    def outcome(self) -> RunOutcome:
        """Wait for the end; the lamp is dark then."""
        assert self.done.wait(30)
        self.session.join(30)
        assert self.world.illumination is None
        (outcome,) = self.outcomes
        return outcome

    def refused(self) -> TrialLensOutcome:
        """Wait for the end of a run that changed nothing; return its readings and findings."""
        outcome = self.outcome()
        assert (outcome.result, self.archive.active_id()) == (None, self.before)
        assert outcome.lenses is not None
        assert outcome.lenses.stored is None
        assert outcome.failure is outcome.lenses.failure is not None
        return outcome.lenses


Begin = Callable[..., Run]


@pytest.fixture
def begin(template: tuple[World, Calibration], tmp_path: Path) -> Iterator[Begin]:
    runs: list[Run] = []

    def made(off: PowerVector = PowerVector(0.2)) -> Run:  # noqa: B008 (a frozen value)
        runs.append(Run(*template, tmp_path, off))
        return runs[-1]

    yield made
    for run in runs:
        run.clock.gate.set()
        run.session.stop()
        run.session.join(30)


def test_each_lens_is_asked_for_once_and_the_offset_is_then_in_force(begin: Begin) -> None:
    run = begin()
    for number in range(len(TRIAL_LENSES)):
        assert [reading.lens for reading in run.asked(number).found.values()] == list(TRIAL_LENSES[:number])
        assert run.placed[number:] == [(TRIAL_LENSES[number], 12.0)]
        run.session.ready(number)
    outcome = run.outcome()
    assert outcome.failure is None
    assert not outcome.was_measured, "the page shows readings, not the figures of a calibration"
    assert outcome.lenses is not None
    assert outcome.lenses.fit is not None
    stored = run.archive.load()
    assert stored.calibration.refraction_offset == outcome.lenses.fit.offset
    assert stored.calibration.refraction_offset.m_dpt == pytest.approx(0.2)
    assert outcome.result is outcome.lenses.stored is not None
    assert outcome.result.calibration.id == stored.calibration.id != run.before
    assert run.world.identity == HeadIdentity(WHO.serial, stored.calibration.id), "the head's memory names it"


def test_a_head_outside_its_limits_is_refused_with_its_findings(begin: Begin) -> None:
    run = begin(PowerVector(-0.7))
    run.show(*range(6))
    lenses = run.refused()
    assert isinstance(lenses.failure, CalibrationRefused)
    assert lenses.fit is not None
    (failing,) = (finding for finding in lenses.fit.findings if finding.fails)
    assert (failing.name, failing.remedy) == ("offset", lenses.failure.remedy)


def test_readings_that_determine_nothing_are_refused_without_findings(begin: Begin) -> None:
    run = begin(PowerVector(float("nan")))
    run.show(*range(6))
    lenses = run.refused()
    assert lenses.fit is None
    assert len(lenses.readings) == 6


def test_a_failed_measurement_is_reported_and_the_same_lens_is_asked_for_again(begin: Begin) -> None:
    run = begin()
    run.show(0)
    run.asked(1)
    for error in (CalibrationRefused("no vessels"), CameraMissing("unplugged")):
        run.checks[0].failing.append(error)
        run.session.ready(1)
        until(partial(run.has_asked_again, error))
        assert (run.now.step, len(run.now.found)) == (1, 1)
    run.session.ready(1)
    assert run.asked(2).error is None


def test_a_lens_is_measured_only_while_it_is_asked_for(begin: Begin) -> None:
    run = begin()
    run.asked(0)
    with pytest.raises(Busy, match="lens 1 is asked for, not lens 2"):
        run.session.ready(1)
    run.clock.gate.clear()
    run.session.ready(0)
    assert run.clock.is_sleeping.wait(10)  # in the lit exposure
    with pytest.raises(Busy, match="no lens is asked for now"):
        run.session.ready(0)
    run.clock.gate.set()
    assert len(run.asked(1).found) == 1, "a button that was pressed twice measures once"
    with pytest.raises(Busy):
        run.session.ready(0)


@pytest.mark.parametrize("shown", [0, 1, 5])
def test_a_stop_while_a_lens_is_asked_for_changes_nothing(begin: Begin, shown: int) -> None:
    run = begin()
    run.show(*range(shown))
    run.asked(shown)
    run.session.stop()
    assert run.outcome() == RunOutcome()
    assert run.archive.active_id() == run.before


def test_a_stop_while_the_lamp_is_on_ends_the_run_after_this_frame(begin: Begin) -> None:
    run = begin()
    run.show(0, 1, 2, 3, 4)
    run.asked(5)
    run.clock.gate.clear()
    run.clock.is_sleeping.clear()
    run.session.ready(5)
    assert run.clock.is_sleeping.wait(10)
    assert run.world.illumination is not None
    run.session.stop()
    run.clock.gate.set()
    assert run.outcome() == RunOutcome(), "the readings of all lenses are there, and are not judged"
    assert run.archive.active_id() == run.before


def test_a_stop_before_the_lit_frame_leaves_the_lamp_dark(begin: Begin) -> None:
    run = begin()
    run.asked(0)
    run.world.faults.add("camera.missing")  # until the stop is known
    run.session.ready(0)
    run.session.stop()
    run.world.faults.clear()
    assert run.outcome() == RunOutcome()


def test_an_archive_that_cannot_be_written_refuses_the_offset(begin: Begin) -> None:
    run = begin()
    run.show(0, 1, 2, 3, 4)
    run.asked(5)
    root = run.archive.root
    root.rename(root.with_name("elsewhere"))
    root.write_text("a file where the folder should be")
    run.session.ready(5)
    outcome = run.outcome()
    assert outcome.failure is not None
    assert (outcome.failure.code, outcome.result) == ("store", None)


def test_a_memory_that_does_not_answer_keeps_the_calibration_that_it_names(begin: Begin) -> None:
    run = begin()
    run.show(0, 1, 2, 3, 4)
    run.asked(5)
    run.world.faults.add("bus.silent")
    run.session.ready(5)
    failure = run.refused().failure
    assert failure is not None
    assert failure.code == "bus.fault"


def test_a_head_that_cannot_be_opened_ends_the_run(begin: Begin) -> None:
    run, ended = begin(), list[RunOutcome]()

    def broken() -> Head:
        raise CameraMissing("the camera does not answer")

    parts = RunParts(run.world.spec, run.archive, run.clock, Watchdog(None), run.no_bench, broken)
    session = TrialLensSession(parts, TrialLensRequest(LensBench()), ended.append)
    session.join(30)
    (outcome,) = ended
    assert isinstance(outcome.failure, DiffuscopeError)
    assert (outcome.failure.code, outcome.is_unexpected, outcome.lenses) == ("camera.missing", False, None)
