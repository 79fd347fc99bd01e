"""Dose limit of the guard: no sequence of calls, crashes or clock jumps exceeds it or leaves the lamp on.

The reference model integrates the true irradiance on each eye in true time with its own arithmetic. It shares no code
with the dose ledger and keeps every exposure.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from device.errors import LightLimit, StoreError, StoreFull
from device.light_safety.burst import burst
from device.light_safety.dose_ledger import DoseLedgerState, Ledger, MemoryLedger, Reserved
from device.light_safety.guard import AFTERGLOW_S, GuardedLight
from device.light_safety.hazard import Beam, Hazard, light_limits
from device.values import EYES, ExposureSettings, Eye, Frame, Illumination
from services.records import schema
from services.records.dose_ledger_tables import DoseLedgerStore

MAX_ON_S, DAY_S = 30.0, 86400.0
# Bright enough that a few exposures reach the limit; a weight of 1, so that the model needs no table.
TRUE_W_PER_CM2 = {"red": 20e-6, "green": 100e-6, "blue": 109e-6}
BEAMS = {"red": Beam(0.440, 20e-6, 1e-6), "green": Beam(0.440, 100e-6, 1e-6), "blue": Beam(0.440, 109e-6, 1e-6)}
STOP_J_PER_CM2, STOP_WITHOUT_VISIT_J_PER_CM2 = 0.02, 0.012
LIMITS = light_limits()
DOSE = LIMITS.photochemical_dose
SHARES = {
    "share": STOP_J_PER_CM2 / DOSE.limit,
    "share_without_visit": STOP_WITHOUT_VISIT_J_PER_CM2 / DOSE.limit,
}
SMALL = LIMITS.model_copy(update={"photochemical_dose": DOSE.model_copy(update=SHARES)})  # limits that a test can reach


@dataclass
class Times:
    """True time, and the two clocks derived from it: time since boot and wall clock."""

    true_s: float = 0.0
    booted_s: float = 0.0
    wall_error_s: float = 0.0

    def now_s(self) -> float:
        return self.true_s - self.booted_s

    def wall(self) -> datetime:
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=self.true_s + self.wall_error_s)

    def sleep(self, duration_s: float) -> None:
        self.true_s += duration_s


@dataclass
class Lamp:
    """Simulated lamp: it keeps its last colour until another one is set or its gate closes."""

    glow: Illumination | None = None
    requested: Illumination | None = None

    @property
    def illumination(self) -> Illumination | None:
        return self.glow

    def on(self, glow: Illumination) -> "Lamp":
        self.requested = glow
        return self

    def off(self) -> None:
        self.glow = None

    def __enter__(self) -> "Lamp":
        self.glow = self.requested
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.off()


@dataclass
class Disk:
    """Persistent state of the ledger, which survives the process, and whether the disk is full."""

    page: DoseLedgerState = field(default_factory=DoseLedgerState)
    full: bool = False


class LedgerOnDisk:
    """Wrapper of a ledger on a disk that may be full."""

    def __init__(self, ledger: Ledger, disk: Disk) -> None:
        self._ledger, self._disk = ledger, disk

    def spent_j_per_cm2(self, eye: Eye) -> float:
        return self._ledger.spent_j_per_cm2(eye)

    def reserve(self, eyes: Any, dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        self._check()
        return self._ledger.reserve(eyes, dose_j_per_cm2, stop_j_per_cm2)

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        self._check()
        self._ledger.settle(reserved, given_j_per_cm2)

    def _check(self) -> None:
        if self._disk.full:
            raise StoreFull("no room")


class TimedCamera:
    """Camera whose exposures take true time."""

    def __init__(self, owner: "Eyes", slow: float) -> None:
        self.owner, self.slow = owner, slow

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        """Return a frame; it takes `slow` times its exposure, and the guard's timer may expire meanwhile."""
        self.owner.keep_on(self.slow * shot.exposure_s)
        lit = self.owner.guarded.illumination
        return Frame(np.zeros((2, 2), np.uint16), shot.exposure_s, 1, lit, simulated=True)


class Eyes(RuleBasedStateMachine):
    """State machine of an instrument under random operations."""

    def __init__(self) -> None:
        super().__init__()
        self.times, self.lamp, self.disk, self.boots = Times(), Lamp(), Disk(), 0
        self.cleanup = ExitStack()
        self.received: dict[Eye, list[tuple[float, float, float]]] = {eye: [] for eye in EYES}  # from, to, J/cm2
        self.ends_without_visit_s: dict[Eye, list[float]] = {eye: [] for eye in EYES}
        self.exposed_eyes: tuple[Eye, ...] = ()
        self.in_visit = False
        self.open_context: Any = None
        self.lit_s = 0.0
        self.start()

    def ledger(self) -> Ledger:
        return MemoryLedger(self.times, DAY_S, self.disk.page, boot=str(self.boots))

    def start(self) -> None:
        ledger = LedgerOnDisk(self.ledger(), self.disk)
        self.guarded = GuardedLight(self.lamp, self.times, MAX_ON_S, Hazard(BEAMS, SMALL), ledger)

    def teardown(self) -> None:
        self.guarded.off()
        self.cleanup.close()

    def pass_true_time(self, duration_s: float) -> None:
        """Advance true time, and add the dose of a lit lamp to the exposed eyes."""
        if self.lamp.glow is not None:
            dose = self.lamp.glow.level * TRUE_W_PER_CM2[self.lamp.glow.colour] * duration_s
            for eye in self.exposed_eyes:
                self.received[eye].append((self.times.true_s, self.times.true_s + duration_s, dose))
                if not self.in_visit:
                    self.ends_without_visit_s[eye].append(self.times.true_s + duration_s)
        self.times.sleep(duration_s)

    @contextmanager
    def lamp_is_off_after_a_refusal(self) -> Iterator[None]:
        try:
            yield
        except (LightLimit, StoreError):
            assert self.lamp.glow is None

    @precondition(lambda self: self.open_context is None)
    @rule(
        colour=st.sampled_from(sorted(BEAMS)),
        level=st.floats(0.01, 1),
        eyes=st.sampled_from([("OD",), ("OS",), ("OD", "OS")]),
        in_visit=st.booleans(),
    )
    def switch_on(self, colour: Any, level: float, eyes: tuple[Eye, ...], in_visit: bool) -> None:
        context = self.guarded.on(Illumination(colour, level), eyes, in_visit=in_visit)
        assert self.lamp.glow is None
        self.exposed_eyes, self.in_visit, self.lit_s = eyes, in_visit, 0.0
        with self.lamp_is_off_after_a_refusal():
            context.__enter__()
            assert not self.disk.full, "light without a record"
            self.open_context = context

    @precondition(lambda self: self.open_context is not None)
    @rule(duration_s=st.floats(0, 2 * MAX_ON_S))
    def keep_on(self, duration_s: float) -> None:
        """Keep the lamp on; the guard's timer expires at MAX_ON_S."""
        if self.lit_s + duration_s < MAX_ON_S:
            self.lit_s += duration_s
            self.pass_true_time(duration_s)
            return
        left_s = max(0.0, MAX_ON_S - self.lit_s)
        self.pass_true_time(left_s)
        self.guarded.cut()
        assert self.lamp.glow is None
        self.lit_s = MAX_ON_S
        self.pass_true_time(duration_s - left_s)

    @precondition(lambda self: self.open_context is not None)
    @rule()
    def switch_off(self) -> None:
        self.open_context.__exit__(None, None, None)
        self.open_context = None

    @precondition(lambda self: self.open_context is not None)
    @rule()
    def open_a_second_context(self) -> None:
        with self.lamp_is_off_after_a_refusal():
            self.guarded.on(Illumination("blue")).__enter__()
        assert self.lamp.glow is None
        self.open_context = None

    @rule(
        colour=st.sampled_from(sorted(BEAMS)), eye=st.sampled_from(EYES), pairs=st.integers(1, 12),
        rest_s=st.floats(30, 90), in_visit=st.booleans(),
    )  # fmt: skip
    def expose_repeatedly(self, colour: Any, eye: Eye, pairs: int, rest_s: float, in_visit: bool) -> None:
        """Repeat exposures of the longest duration."""
        for _ in range(pairs):
            if self.open_context is None:
                self.switch_on(colour, 1.0, (eye,), in_visit)
            if self.open_context is not None:
                self.keep_on(0.99 * MAX_ON_S)
                self.switch_off()
            self.pass_time(rest_s)

    @precondition(lambda self: self.open_context is None)
    @rule(
        colours=st.lists(st.sampled_from(sorted(BEAMS)), min_size=1, max_size=3), eye=st.sampled_from(EYES),
        count=st.integers(1, 16), exposure_s=st.floats(0.01, 10), slow=st.floats(1, 3), in_visit=st.booleans(),
    )  # fmt: skip
    def take_bursts(
        self, colours: list[Any], eye: Eye, count: int, exposure_s: float, slow: float, in_visit: bool
    ) -> None:
        """Take a burst of frames in each colour; a slow camera may not hold the light longer than the guard permits."""
        camera, shot = TimedCamera(self, slow), ExposureSettings(exposure_s)
        for colour in colours:
            self.exposed_eyes, self.in_visit, self.lit_s = (eye,), in_visit, 0.0
            light, glow = self.guarded, Illumination(colour)
            with self.lamp_is_off_after_a_refusal():
                frames = burst(camera, light, glow, shot, count, self.times, (eye,), in_visit=in_visit)
                assert 1 <= len(frames) <= count
                assert not self.disk.full, "light without a record"
            assert self.lamp.glow is None

    @precondition(lambda self: self.open_context is None)
    @rule(duration_s=st.one_of(st.floats(0, 120), st.floats(0, 1.2 * DAY_S), st.floats(DAY_S - 1800, DAY_S)))
    def pass_time(self, duration_s: float) -> None:
        self.pass_true_time(duration_s)

    @rule(
        off_s=st.one_of(st.just(0.0), st.floats(0, 2 * DAY_S)),
        afterglow_s=st.floats(0, AFTERGLOW_S),
        reboot_s=st.one_of(st.none(), st.floats(0, 10 * DAY_S)),
    )
    def crash(self, off_s: float, afterglow_s: float, reboot_s: float | None) -> None:
        """End the process; the lamp is on until its gate closes; `reboot_s` is the new value of the boot clock."""
        self.pass_true_time(afterglow_s)
        self.lamp.off()
        if self.guarded._timer is not None:
            self.guarded._timer.cancel()  # the timer ends with its process
        self.times.sleep(off_s)
        if reboot_s is not None:
            self.boots += 1
            self.times.booted_s = self.times.true_s - reboot_s
        self.open_context = None
        self.start()

    @rule(jump_s=st.one_of(st.floats(-3 * DAY_S, 3 * DAY_S), st.sampled_from([-DAY_S, DAY_S, 400 * DAY_S])))
    def change_the_date(self, jump_s: float) -> None:
        self.times.wall_error_s = max(-500 * DAY_S, min(self.times.wall_error_s + jump_s, 5000 * DAY_S))

    @rule()
    def fill_or_free_the_disk(self) -> None:
        self.disk.full = not self.disk.full

    @invariant()
    def lamp_is_off_without_a_context(self) -> None:
        assert self.lamp.glow is None or self.open_context is not None

    @invariant()
    def no_eye_exceeds_the_dose_limit_in_any_day(self) -> None:
        for eye, received in self.received.items():
            for _, end_s, _ in received[-40:]:  # the dose of a window is largest if it ends with an exposure
                assert self.received_before_j_per_cm2(eye, end_s) <= STOP_J_PER_CM2 * (1 + 1e-9), eye

    @invariant()
    def no_light_without_a_visit_exceeds_its_lower_limit(self) -> None:
        for eye, ends_s in self.ends_without_visit_s.items():
            for end_s in ends_s[-40:]:
                assert self.received_before_j_per_cm2(eye, end_s) <= STOP_WITHOUT_VISIT_J_PER_CM2 * (1 + 1e-9), eye

    def received_before_j_per_cm2(self, eye: Eye, end_s: float) -> float:
        """Return the true dose of the day that ends at `end_s`."""
        received = self.received[eye]
        return sum(dose for begin_s, over_s, dose in received if over_s > end_s - DAY_S and begin_s < end_s)

    @invariant()
    def the_ledger_is_at_least_the_true_dose(self) -> None:
        """Check the ledger against the true dose; the interval in progress is covered by its reservation."""
        for eye, received in self.received.items():
            day = [dose for _, over_s, dose in received if over_s > self.times.true_s - DAY_S]
            assert self.guarded.ledger.spent_j_per_cm2(eye) >= sum(day) - 1e-12


class EyesWithDatabase(Eyes):
    """The same state machine with the ledger in its database, which every crash opens again."""

    def ledger(self) -> Ledger:
        if self.boots == 0 and not hasattr(self, "folder"):
            self.folder = self.cleanup.enter_context(TemporaryDirectory())
        engine = schema.open_engine(f"{self.folder}/shelf.sqlite")
        self.cleanup.callback(engine.dispose)
        schema.migrate(engine, lambda _: None)
        return DoseLedgerStore(engine, self.times, DAY_S, boot=str(self.boots))


TestEyes = Eyes.TestCase
TestEyes.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestEyesWithDatabase = EyesWithDatabase.TestCase
TestEyesWithDatabase.settings = settings(max_examples=6, stateful_step_count=15, deadline=None)
