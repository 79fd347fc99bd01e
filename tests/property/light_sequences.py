"""Random sequences of light: presses in every mode, aiming, bare contexts, kills, reboots, clock jumps, a full disk.

The reference model integrates the true irradiance on each eye in true time with its own arithmetic. It shares no code
with the dose ledger and keeps every exposure. `make test-light` runs a thousand sequences with the ledger in its
database, and prints the dose of a press in each mode.
"""

import logging
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, ClassVar

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.errors import LightLimit, StoreError, StoreFull
from device.head import Head, open_head
from device.light_safety.burst import burst
from device.light_safety.dose_ledger import DoseLedgerState, Ledger, MemoryLedger, Reserved
from device.light_safety.guard import LIT_AFTER_KILL_S, GuardedLight
from device.light_safety.hazard import Beam, Hazard, light_limits
from device.recon.assessment.exposure_split import WHOLE, ExposureSplit
from device.values import EYES, Calibration, Colour, ExposureSettings, Eye, Frame, Illumination, Psf, Sensor
from services.instrument.press_exposure import expose_live, expose_press
from services.records import schema
from services.records.dose_ledger_tables import DoseLedgerStore
from tests.simulated import small_head_toml

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
COLOURS: tuple[Colour, ...] = ("red", "blue")  # that a press may take beside its green frames
MODES: tuple[tuple[int, tuple[Colour, ...]], ...] = (
    (1, ()),
    (4, ()),
    (4, ("red",)),
    (4, ("red", "blue")),
    (16, ("red",)),
)
SPEC = InstrumentSpec.model_validate(tomllib.loads(small_head_toml("small")))
CALIBRATION = Calibration((Psf(np.ones((2, 2), np.float32)),), Sensor())


class Killed(BaseException):
    """SIGKILL of the process: nothing of it runs any more, so its lamp stays on until the gate closes."""


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
    """Simulated lamp: it keeps its last colour until another one is set or its gate closes.

    After a kill of its process (`is_orphaned`) only `close_gate` turns it off. `stretches` counts how often it went on.
    """

    shown: Illumination | None = None
    requested: Illumination | None = None
    is_orphaned: bool = False
    stretches: int = 0

    @property
    def illumination(self) -> Illumination | None:
        return self.shown

    def on(self, illumination: Illumination) -> "Lamp":
        self.requested = illumination
        return self

    def off(self) -> None:
        if not self.is_orphaned:
            self.shown = None

    def close_gate(self) -> None:
        self.is_orphaned, self.shown = False, None

    def __enter__(self) -> "Lamp":
        self.shown = self.requested
        self.stretches += 1
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.off()


@dataclass
class Disk:
    """Persistent state of the ledger, which survives the process, and whether the disk is full."""

    state: DoseLedgerState = field(default_factory=DoseLedgerState)
    full: bool = False


class LedgerOnDisk:
    """Wrapper of a ledger on a disk that may be full; after a kill of its process it writes nothing any more."""

    def __init__(self, ledger: Ledger, disk: Disk) -> None:
        self._ledger, self._disk = ledger, disk
        self.is_killed = False

    def spent_j_per_cm2(self, eye: Eye) -> float:
        return self._ledger.spent_j_per_cm2(eye)

    def reserve(self, eyes: Any, dose_j_per_cm2: float, stop_j_per_cm2: float) -> Reserved:
        self._check()
        return self._ledger.reserve(eyes, dose_j_per_cm2, stop_j_per_cm2)

    def settle(self, reserved: Reserved, given_j_per_cm2: float) -> None:
        if self.is_killed:
            return
        self._check()
        self._ledger.settle(reserved, given_j_per_cm2)

    def _check(self) -> None:
        if self._disk.full:
            raise StoreFull("no room")


class TimedCamera:
    """Camera whose exposures take true time; the process is killed in the exposure `kill_at` (None: never)."""

    def __init__(self, owner: "Eyes", slow: float, kill_at: int | None = None) -> None:
        self.owner, self.slow, self.kill_at = owner, slow, kill_at
        self._stretch = owner.lamp.stretches

    def prepare(self, shot: ExposureSettings) -> None:
        """Nothing: any exposure time is ready."""

    def expose(self, shot: ExposureSettings, into: Any = None) -> Frame:
        """Return a frame; it takes `slow` times its exposure, and the guard's timer may expire meanwhile."""
        owner, duration_s = self.owner, self.slow * shot.exposure_s
        if owner.lamp.stretches != self._stretch:
            self._stretch, owner.lit_s = owner.lamp.stretches, 0.0
        if owner.lamp.shown is None:
            owner.pass_true_time(duration_s)
        else:
            owner.keep_on(duration_s if self.kill_at != 0 else duration_s / 2)
        if self.kill_at == 0:
            owner.kill()
            raise Killed
        self.kill_at = None if self.kill_at is None else self.kill_at - 1
        lit = owner.guarded.illumination
        return Frame(np.zeros((2, 2), np.uint16), shot.exposure_s, 1, lit, simulated=True)


class Eyes(RuleBasedStateMachine):
    """State machine of an instrument under random operations; `tally` counts them over all sequences."""

    tally: ClassVar[Counter[str]] = Counter()

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
        return MemoryLedger(self.times, DAY_S, self.disk.state, boot=str(self.boots))

    def start(self) -> None:
        self.wrapped = LedgerOnDisk(self.ledger(), self.disk)
        self.guarded = GuardedLight(self.lamp, self.times, MAX_ON_S, Hazard(BEAMS, SMALL), self.wrapped)

    def head(self, camera: TimedCamera, exposure_s: float) -> Head:
        """Return the small head with this camera, the guarded lamp and this exposure."""
        exposures = {"exposure_s": exposure_s, "preview_exposure_s": exposure_s}
        spec = SPEC.model_copy(update={"camera": SPEC.camera.model_copy(update=exposures)})
        return Head(spec, camera, self.guarded, CALIBRATION)

    def kill(self) -> None:
        """Kill the process: neither lamp nor ledger hear of it any more. `crash` ends it."""
        self.tally["killed while lit" if self.lamp.shown is not None else "killed in the dark"] += 1
        self.lamp.is_orphaned = self.wrapped.is_killed = True

    def teardown(self) -> None:
        self.guarded.off()
        self.cleanup.close()

    def pass_true_time(self, duration_s: float) -> None:
        """Advance true time, and add the dose of a lit lamp to the exposed eyes."""
        if self.lamp.shown is not None:
            dose = self.lamp.shown.level * TRUE_W_PER_CM2[self.lamp.shown.colour] * duration_s
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
            self.tally["refused"] += 1
            assert self.lamp.shown is None

    @precondition(lambda self: self.open_context is None)
    @rule(
        colour=st.sampled_from(sorted(BEAMS)),
        level=st.floats(0.01, 1),
        eyes=st.sampled_from([("OD",), ("OS",), ("OD", "OS")]),
        in_visit=st.booleans(),
    )
    def switch_on(self, colour: Any, level: float, eyes: tuple[Eye, ...], in_visit: bool) -> None:
        context = self.guarded.on(Illumination(colour, level), eyes, in_visit=in_visit)
        assert self.lamp.shown is None
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
        assert self.lamp.shown is None
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
        assert self.lamp.shown is None
        self.open_context = None

    @rule(
        colour=st.sampled_from(sorted(BEAMS)),
        eye=st.sampled_from(EYES),
        pairs=st.integers(1, 12),
        rest_s=st.floats(30, 90),
        in_visit=st.booleans(),
    )
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
        colours=st.lists(st.sampled_from(sorted(BEAMS)), min_size=1, max_size=3),
        eye=st.sampled_from(EYES),
        count=st.integers(1, 16),
        exposure_s=st.floats(0.01, 10),
        slow=st.floats(1, 3),
        in_visit=st.booleans(),
    )
    def take_bursts(
        self, colours: list[Any], eye: Eye, count: int, exposure_s: float, slow: float, in_visit: bool
    ) -> None:
        """Take a burst of frames in each colour; a slow camera may not hold the light longer than the guard permits."""
        camera, shot = TimedCamera(self, slow), ExposureSettings(exposure_s)
        for colour in colours:
            self.exposed_eyes, self.in_visit, self.lit_s = (eye,), in_visit, 0.0
            light, illumination = self.guarded, Illumination(colour)
            with self.lamp_is_off_after_a_refusal():
                frames = burst(
                    camera, light, illumination, shot, count, self.times, (eye,), whole_s=exposure_s, in_visit=in_visit
                )
                assert 1 <= len(frames) <= count
                assert not self.disk.full, "light without a record"
            assert self.lamp.shown is None

    @precondition(lambda self: self.open_context is None)
    @rule(
        eye=st.sampled_from(EYES),
        count=st.integers(1, 16),
        colours=st.lists(st.sampled_from(COLOURS), unique=True),
        exposure_s=st.floats(0.01, 3),
        slow=st.floats(1, 3),
        in_visit=st.booleans(),
        parts=st.integers(1, 8),
        overhead_share=st.floats(0, 0.5),
        kill_at=st.one_of(st.none(), st.integers(0, 18)),
        lit_after_kill_s=st.floats(0, LIT_AFTER_KILL_S),
    )
    def press(
        self,
        eye: Eye,
        count: int,
        colours: list[Colour],
        exposure_s: float,
        slow: float,
        in_visit: bool,
        parts: int,
        overhead_share: float,
        kill_at: int | None,
        lit_after_kill_s: float,
    ) -> None:
        """Expose as a press does: a dark frame, a burst in green, other colours; a kill may come in any of them.

        Exposures are split as for an overhead of `overhead_share` of a part, which is not that of the camera.
        """
        split = WHOLE
        if parts > 1:
            part_s = exposure_s / (parts + (parts - 1) * overhead_share)
            split = ExposureSplit(parts, part_s=part_s)
        self.exposed_eyes, self.in_visit = (eye,), in_visit
        head = self.head(TimedCamera(self, slow, kill_at), exposure_s)
        try:
            with self.lamp_is_off_after_a_refusal():
                made = expose_press(
                    head, (eye,), self.times, in_visit=in_visit, count=count, colours=colours, split=split
                )
                assert not self.disk.full, "light without a record"
                assert sum(frame.exposure_s for frame in made.lit) <= count * exposure_s * (1 + 1e-9)
                self.tally["split press"] += parts > 1
                self.tally[f"press of {len(made.lit)} frames and {len(made.colours)} colours"] += 1
        except Killed:
            self.crash(0.0, lit_after_kill_s, None)

    @precondition(lambda self: self.open_context is None)
    @rule(
        eyes=st.sampled_from([("OD",), ("OS",), ("OD", "OS")]),
        pictures=st.integers(1, 40),
        exposure_s=st.floats(0.01, 0.2),
        in_visit=st.booleans(),
    )
    def aim(self, eyes: tuple[Eye, ...], pictures: int, exposure_s: float, in_visit: bool) -> None:
        """Take live pictures, until one is refused."""
        self.exposed_eyes, self.in_visit = eyes, in_visit
        head = self.head(TimedCamera(self, 1.0), exposure_s)
        with self.lamp_is_off_after_a_refusal():
            for _ in range(pictures):
                expose_live(head, eyes, self.times, in_visit=in_visit)
                self.tally["live picture"] += 1

    @precondition(lambda self: self.open_context is None)
    @rule(duration_s=st.one_of(st.floats(0, 120), st.floats(0, 1.2 * DAY_S), st.floats(DAY_S - 1800, DAY_S)))
    def pass_time(self, duration_s: float) -> None:
        self.pass_true_time(duration_s)

    @rule(
        off_s=st.one_of(st.just(0.0), st.floats(0, 2 * DAY_S)),
        lit_after_kill_s=st.floats(0, LIT_AFTER_KILL_S),
        reboot_s=st.one_of(st.none(), st.floats(0, 10 * DAY_S)),
    )
    def crash(self, off_s: float, lit_after_kill_s: float, reboot_s: float | None) -> None:
        """End the process; the lamp is on until its gate closes; `reboot_s` is the new value of the boot clock."""
        if not self.lamp.is_orphaned:
            self.kill()
        self.guarded.off()  # reaches neither lamp nor ledger, but ends the timer, as the process ends
        self.pass_true_time(lit_after_kill_s)
        self.lamp.close_gate()
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
        assert self.lamp.shown is None or self.open_context is not None

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
        engine = schema.open_engine(f"{self.folder}/store.sqlite")
        self.cleanup.callback(engine.dispose)
        schema.migrate(engine, lambda _: None)
        return DoseLedgerStore(engine, self.times, DAY_S, boot=str(self.boots))


def run(count: int, machine: type[Eyes], steps: int) -> Counter[str]:
    """Run `count` random sequences of up to `steps` operations; return how often each happened.

    Raises the AssertionError of the first violation, with its shortest sequence.
    """
    machine.tally = Counter()
    limits = settings(max_examples=count, stateful_step_count=steps, deadline=None, database=None)
    run_state_machine_as_test(machine, settings=limits)
    return machine.tally


def doses_j_per_cm2(frames: int, colours: tuple[Colour, ...]) -> float:
    """Return the dose of one press of the simulated head, by the ledger."""
    clock = VirtualClock()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "head.toml"
        file.write_text(small_head_toml("small").replace("[light]", f"[light]\nmax_on_s = {MAX_ON_S}"))  # real time
        head = open_head(load_head(file), clock, MemoryLedger(clock))
    try:
        expose_press(head, ("OD",), clock, in_visit=True, count=frames, colours=colours)
        return head.light.ledger.spent_j_per_cm2("OD")
    finally:
        head.close()


def main() -> int:
    """Run the sequences with the ledger in its database; print the figures."""
    logging.disable(logging.WARNING)  # each refused colour is logged
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    begin_s = time.monotonic()
    tally = run(count, EyesWithDatabase, 15)
    sys.stdout.write(f"{count} sequences in {time.monotonic() - begin_s:.0f} s, no violation\n")
    sys.stdout.write(", ".join(f"{name} {number}" for name, number in sorted(tally.items())) + "\n")
    for frames, colours in MODES:
        dose = doses_j_per_cm2(frames, colours)
        sys.stdout.write(f"{' and '.join([f'{frames} green', *colours])}: {dose:.3g} J/cm2 a press\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
