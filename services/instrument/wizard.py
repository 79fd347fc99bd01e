"""A calibration in the technician's hands: one thing is asked for, shown, measured; then the next.

The wizard owns the head while it is there, as the exam does otherwise: one thread opens the bench, runs the procedure,
and lets the head go. What a step refuses is said, and the same step is asked for again; nothing can be skipped.
"""

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from threading import Condition, Thread
from typing import Any

from device.calibration.archive import Archive, Kept
from device.calibration.procedure import BRACKETS, FRAMES, LEVELS, MANY, Operator, Procedure, Stand
from device.clock import Clock
from device.errors import Busy, CalibrationStopped, DiffuscopeError, SettingError, StoreFull
from device.head import Bench
from device.sim.mishaps import MISHAPS, mend, spoil
from device.spec import InstrumentSpec
from services.instrument.calibrating import WORK, Wish, job_of, note_in_head, staging
from services.instrument.peephole import Peephole, Sight
from services.instrument.watchdog import BEAT_S, Watchdog

log = logging.getLogger(__name__)

STANDS: tuple[Stand, ...] = ("cap", "screen", "point")
SEARCH = 6  # frames in which the right exposure is found, about
FRAMES_OF = {
    "cap": 3 * MANY, "screen": SEARCH + len(LEVELS) * FRAMES + 2, "point": SEARCH + sum(n for _, n in BRACKETS),
}  # fmt: skip
RETRY_S = 1.0
NOT_KEPT = "Free some space, or give the instrument a folder that it may write into, then measure this step again."


@dataclass(frozen=True)
class Back:
    """The wish to go back to an earlier calibration instead of measuring a new one."""

    id: str


@dataclass
class _Now:
    """What the wizard does now: `begin` (waits to be started), `asking` (for a stand), `measuring` (it)."""

    state: str = "begin"
    stand: Stand | None = None
    frames: int = 0
    error: DiffuscopeError | None = None
    found: dict[Stand, dict[str, float]] = field(default_factory=dict)


class Wizard:
    """One calibration, from opening the bench to the new one in force; `ended` is called once the head is free again.

    Without a wish it is there because no picture can be taken, and waits until somebody starts it.
    `result` is what is in force now, `made` whether it was measured for that; `failure` why it ended otherwise, None if
    the technician stopped it; `broken` says that nobody foresaw that failure.
    """

    def __init__(
        self, spec: InstrumentSpec, bench: Callable[[], Bench], archive: Archive, clock: Clock, watchdog: Watchdog,
        wish: Wish | Back | None, ended: Callable[["Wizard"], None],
    ) -> None:  # fmt: skip
        self.spec, self.archive, self.clock = spec, archive, clock
        self.result: Kept | None = None
        self.made = False
        self.failure: DiffuscopeError | None = None
        self.broken = False
        self._bench, self._watchdog, self._wish, self._ended = bench, watchdog, wish, ended
        self._needed = wish is None
        self._turn = Condition()
        self._now = _Now()
        self._ready = self._stopping = self._asked_since = False
        self._mishap: str | None = None
        self._peephole: Peephole | None = None
        self._thread = Thread(target=self._own_the_head, name="head", daemon=True)
        self._thread.start()

    # What others ask of it, from any thread

    def start(self, wish: Wish | Back) -> None:
        """Begin; Busy if it has begun."""
        with self._turn:
            if self._now.state != "begin" or self._wish is not None:
                raise Busy("a calibration is under way", "Go on with it, or cancel it first.")
            self._wish = wish
            self._now.error = None
            self._turn.notify_all()

    def ready(self, stand: str, mishap: str | None = None) -> None:
        """It stands there: measure it. Busy if this is not what is asked for; a mishap is for simulated heads only."""
        if mishap is not None and (self.spec.camera.backend != "sim" or mishap not in MISHAPS):
            raise SettingError(f"{mishap!r} cannot go wrong on this head", "Leave it out.")
        with self._turn:
            if self._now.state != "asking":
                raise Busy("nothing is asked for now", "Wait until the page asks for something.")
            if stand != self._now.stand:
                raise Busy(f"this step wants the {self._now.stand}, not the {stand}", "Read the page again.")
            self._ready, self._mishap = True, mishap
            self._now.state, self._now.error, self._now.frames = "measuring", None, 0
            self._turn.notify_all()

    def stop(self) -> None:
        """End it at the next frame; what was measured is kept, and the old calibration stays in force."""
        with self._turn:
            self._stopping = True
            self._turn.notify_all()

    def join(self, timeout_s: float) -> None:
        """Return once the head is free, or after a while."""
        self._thread.join(timeout_s)

    def look(self, after: int) -> Sight | None:
        """What the sensor sees now; None when there is no news."""
        return self._peephole.look(after) if self._peephole is not None else None

    def told(self) -> dict[str, Any]:
        """What it does now, as the page wants it; progress is 0 to 1, None where nobody knows."""
        with self._turn:
            now = self._now
            expected = FRAMES_OF.get(now.stand or "")
            return {
                "state": now.state, "stand": now.stand, "found": dict(now.found), "error": now.error,
                "progress": min(now.frames / expected, 1.0) if expected else None,
            }  # fmt: skip

    # What the owner of the head does, alone

    def _own_the_head(self) -> None:
        self.failure, self.broken = DiffuscopeError("the instrument stopped unexpectedly"), True
        try:
            with closing(self._bench()) as bench:
                self._watchdog.ready()
                self._watchdog.status("calibrating")
                self._peephole = Peephole(bench.camera, self.spec.camera, self.clock, self._each_frame)
                with closing(self._peephole):
                    while self.result is None:
                        self._attempt(bench)
            self.failure, self.broken = None, False
        except CalibrationStopped:
            self.failure, self.broken = None, False
        except DiffuscopeError as error:  # of opening or closing the bench
            self.failure, self.broken = error, False
        finally:
            self._ended(self)

    def _attempt(self, bench: Bench) -> None:
        """The whole procedure; what it refuses is said, and the next attempt takes up what is done."""
        wish = self._await_wish()
        self._asked_since = False
        try:
            self.made = isinstance(wish, Wish)
            self.result = self._measured(bench, wish) if isinstance(wish, Wish) else self._back(bench, wish)
        except CalibrationStopped:
            raise
        except DiffuscopeError as error:
            self._say(error)
        except OSError as error:
            self._say(StoreFull(f"what was measured cannot be kept: {error}", NOT_KEPT))

    def _say(self, error: DiffuscopeError) -> None:
        """Show it, and be ready for another attempt."""
        log.warning("calibration: %s", error)
        if not self._asked_since and not self._needed:
            raise error  # the exam can have the head back
        with self._turn:
            self._now.error = error
            if not self._asked_since:  # it would only happen again: let the technician begin anew
                self._wish, self._now.state, self._now.stand = None, "begin", None

    def _measured(self, bench: Bench, wish: Wish) -> Kept:
        assert self._peephole is not None
        operator = Operator(lambda stand: self._put(bench, stand), log.info, self._note)
        job = job_of(bench, self.spec, wish, log.info)
        work = self.archive.root / WORK
        procedure = Procedure(job, self._peephole, operator, self.clock, work, bench.chips.thermometer)
        kept = self.archive.load(procedure.run(self.archive))
        note_in_head(bench, kept)
        return kept

    def _back(self, bench: Bench, wish: Back) -> Kept:
        kept = self.archive.load(wish.id)
        self.archive.use(wish.id)
        note_in_head(bench, kept)
        return kept

    def _await_wish(self) -> Wish | Back:
        with self._turn:
            while self._wish is None:
                self._each()
                self._turn.wait(BEAT_S)
            return self._wish

    def _put(self, bench: Bench, stand: Stand) -> None:
        """Ask for a stand, show what the sensor sees meanwhile, and return when somebody says that it is there."""
        if bench.world is not None:
            mend(bench.world)
            staging(bench.world)(stand)
        with self._turn:
            self._ready, self._asked_since = False, True
            self._now.state, self._now.stand, self._now.frames = "asking", stand, 0
        self._show_until_ready()
        if bench.world is not None and self._mishap is not None:
            spoil(bench.world, self._mishap)

    def _show_until_ready(self) -> None:
        assert self._peephole is not None
        exposure_s = self.spec.camera.exposure_s
        while True:
            with self._turn:
                self._each()
                if self._ready:
                    return
                if not self._peephole.wanted:
                    self._turn.wait(min(BEAT_S, 0.2))
                    continue
            try:
                exposure_s = self._peephole.glance(exposure_s)
            except CalibrationStopped:
                raise
            except DiffuscopeError as error:
                with self._turn:
                    self._now.error = error
                    self._turn.wait(RETRY_S)

    def _note(self, stand: Stand, figures: dict[str, float]) -> None:
        with self._turn:
            self._now.found[stand] = figures

    def _each_frame(self) -> None:
        self._now.frames += 1
        self._each()

    def _each(self) -> None:
        self._watchdog.beat()
        if self._stopping:
            raise CalibrationStopped("the technician stopped the calibration")
