"""No sequence of calls, crashes or clock jumps gives an eye more light than the stop, or leaves the lamp on.

The model beside the instrument integrates what really falls on each eye, in true time, with its own arithmetic: it
shares no code with the book of light, and it never forgets.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from device.dose import Beam, Hazard, light_limits
from device.errors import LightLimit, StoreError, StoreFull
from device.guard import AFTERGLOW_S, GuardedLight
from device.ledger import Ledger, MemoryLedger, Page, Reserved
from device.values import EYES, Eye, Glow
from services.records import schema
from services.records.light_book import LightBook

MAX_ON_S, DAY_S = 30.0, 86400.0
# Bright enough that a few exposures reach the stop; a weight of 1, so that the model needs no table.
TRUE_W_PER_CM2 = {"red": 20e-6, "green": 100e-6, "blue": 219e-6}
BEAMS = {"red": Beam(0.440, 20e-6, 1e-6), "green": Beam(0.440, 100e-6, 1e-6), "blue": Beam(0.440, 219e-6, 1e-6)}
STOP_J_PER_CM2 = 0.02
LIMITS = light_limits()
SHARE = STOP_J_PER_CM2 / LIMITS.photochemical_dose.limit
SMALL = LIMITS.model_copy(
    update={"photochemical_dose": LIMITS.photochemical_dose.model_copy(update={"share": SHARE})}
)  # a stop that a test can reach


@dataclass
class Times:
    """True time, and the two clocks that pretend to tell it."""

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
    """A lamp as it is wired: it keeps its last colour until it hears another, or its gate closes."""

    glow: Glow | None = None
    asked: Glow | None = None

    def on(self, glow: Glow) -> "Lamp":
        self.asked = glow
        return self

    def off(self) -> None:
        self.glow = None

    def __enter__(self) -> "Lamp":
        self.glow = self.asked
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.off()


@dataclass
class Disk:
    """Where the book outlives its process, and whether it can be written just now."""

    page: Page = field(default_factory=Page)
    full: bool = False


class FragileLedger:
    """Any ledger, on a disk that may be full."""

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


class Eyes(RuleBasedStateMachine):
    """An instrument in the hands of chance."""

    def __init__(self) -> None:
        super().__init__()
        self.times, self.lamp, self.disk, self.boots = Times(), Lamp(), Disk(), 0
        self.undo = ExitStack()
        self.fallen: dict[Eye, list[tuple[float, float, float]]] = {eye: [] for eye in EYES}  # from, to, J/cm2
        self.looking: tuple[Eye, ...] = ()
        self.holding: Any = None
        self.lit_s = 0.0
        self.start()

    def ledger(self) -> Ledger:
        return MemoryLedger(self.times, DAY_S, self.disk.page, boot=str(self.boots))

    def start(self) -> None:
        ledger = FragileLedger(self.ledger(), self.disk)
        self.guarded = GuardedLight(self.lamp, self.times, MAX_ON_S, Hazard(BEAMS, SMALL), ledger)

    def teardown(self) -> None:
        self.guarded.off()
        self.undo.close()

    def shine_for(self, duration_s: float) -> None:
        """True time passes, and light falls on whoever looks at a lit lamp."""
        if self.lamp.glow is not None:
            dose = self.lamp.glow.level * TRUE_W_PER_CM2[self.lamp.glow.colour] * duration_s
            for eye in self.looking:
                self.fallen[eye].append((self.times.true_s, self.times.true_s + duration_s, dose))
        self.times.sleep(duration_s)

    @contextmanager
    def refusals_are_dark(self) -> Iterator[None]:
        try:
            yield
        except (LightLimit, StoreError):
            assert self.lamp.glow is None

    @precondition(lambda self: self.holding is None)
    @rule(
        colour=st.sampled_from(sorted(BEAMS)),
        level=st.floats(0.01, 1),
        eyes=st.sampled_from([("OD",), ("OS",), ("OD", "OS")]),
    )
    def light_up(self, colour: Any, level: float, eyes: tuple[Eye, ...]) -> None:
        context = self.guarded.on(Glow(colour, level), eyes)
        assert self.lamp.glow is None
        self.looking, self.lit_s = eyes, 0.0
        with self.refusals_are_dark():
            context.__enter__()
            assert not self.disk.full, "light without a record"
            self.holding = context

    @precondition(lambda self: self.holding is not None)
    @rule(duration_s=st.floats(0, 2 * MAX_ON_S))
    def hold(self, duration_s: float) -> None:
        """The holder takes its time; the guard's timer strikes in the midst of it."""
        if self.lit_s + duration_s < MAX_ON_S:
            self.lit_s += duration_s
            self.shine_for(duration_s)
            return
        left_s = max(0.0, MAX_ON_S - self.lit_s)
        self.shine_for(left_s)
        self.guarded._cut()
        assert self.lamp.glow is None
        self.lit_s = MAX_ON_S
        self.shine_for(duration_s - left_s)

    @precondition(lambda self: self.holding is not None)
    @rule()
    def let_go(self) -> None:
        self.holding.__exit__(None, None, None)
        self.holding = None

    @precondition(lambda self: self.holding is not None)
    @rule()
    def a_second_holder(self) -> None:
        with self.refusals_are_dark():
            self.guarded.on(Glow("blue")).__enter__()
        assert self.lamp.glow is None
        self.holding = None

    @rule(
        colour=st.sampled_from(sorted(BEAMS)), eye=st.sampled_from(EYES), pairs=st.integers(1, 12),
        rest_s=st.floats(30, 90),
    )  # fmt: skip
    def a_greedy_operator(self, colour: Any, eye: Eye, pairs: int, rest_s: float) -> None:
        """Exposures as long as they may be, one after the other."""
        for _ in range(pairs):
            if self.holding is None:
                self.light_up(colour, 1.0, (eye,))
            if self.holding is not None:
                self.hold(0.99 * MAX_ON_S)
                self.let_go()
            self.pass_time(rest_s)

    @precondition(lambda self: self.holding is None)
    @rule(duration_s=st.one_of(st.floats(0, 120), st.floats(0, 1.2 * DAY_S), st.floats(DAY_S - 1800, DAY_S)))
    def pass_time(self, duration_s: float) -> None:
        self.shine_for(duration_s)

    @rule(
        off_s=st.one_of(st.just(0.0), st.floats(0, 2 * DAY_S)),
        afterglow_s=st.floats(0, AFTERGLOW_S),
        reboot_s=st.one_of(st.none(), st.floats(0, 10 * DAY_S)),
    )
    def crash(self, off_s: float, afterglow_s: float, reboot_s: float | None) -> None:
        """The process dies; the lamp shines until its gate closes; the computer may start anew, its clock anywhere."""
        self.shine_for(afterglow_s)
        self.lamp.off()
        if self.guarded._timer is not None:
            self.guarded._timer.cancel()  # it died with its process
        self.times.sleep(off_s)
        if reboot_s is not None:
            self.boots += 1
            self.times.booted_s = self.times.true_s - reboot_s
        self.holding = None
        self.start()

    @rule(jump_s=st.one_of(st.floats(-3 * DAY_S, 3 * DAY_S), st.sampled_from([-DAY_S, DAY_S, 400 * DAY_S])))
    def the_date_jumps(self, jump_s: float) -> None:
        self.times.wall_error_s = max(-500 * DAY_S, min(self.times.wall_error_s + jump_s, 5000 * DAY_S))

    @rule()
    def the_disk_fills_up_or_is_freed(self) -> None:
        self.disk.full = not self.disk.full

    @invariant()
    def dark_unless_held(self) -> None:
        assert self.lamp.glow is None or self.holding is not None

    @invariant()
    def no_eye_has_had_more_than_the_stop_in_any_day(self) -> None:
        for eye, fallen in self.fallen.items():
            for _, end_s, _ in fallen[-40:]:  # a window is fullest when it ends with some light
                day = [dose for begin_s, over_s, dose in fallen if over_s > end_s - DAY_S and begin_s < end_s]
                assert sum(day) <= STOP_J_PER_CM2 * (1 + 1e-9), eye

    @invariant()
    def the_book_never_says_less_than_the_truth(self) -> None:
        """Apart from the stretch under way, whose reservation is in the book."""
        for eye, fallen in self.fallen.items():
            day = [dose for _, over_s, dose in fallen if over_s > self.times.true_s - DAY_S]
            assert self.guarded.ledger.spent_j_per_cm2(eye) >= sum(day) - 1e-12


class EyesOnTheShelf(Eyes):
    """The same, with the book in its database: every crash opens it anew."""

    def ledger(self) -> Ledger:
        if self.boots == 0 and not hasattr(self, "folder"):
            self.folder = self.undo.enter_context(TemporaryDirectory())
        engine = schema.open_engine(f"{self.folder}/shelf.sqlite")
        self.undo.callback(engine.dispose)
        schema.migrate(engine, lambda _: None)
        return LightBook(engine, self.times, DAY_S, boot=str(self.boots))


TestEyes = Eyes.TestCase
TestEyes.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestEyesOnTheShelf = EyesOnTheShelf.TestCase
TestEyesOnTheShelf.settings = settings(max_examples=6, stateful_step_count=15, deadline=None)
