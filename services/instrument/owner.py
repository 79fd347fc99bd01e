"""Who has the head now: the exam, or the wizard while the head is calibrated; one after the other, never both."""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from device.calibration.archive import Archive
from device.calibration.finding import Finding
from device.clock import Clock
from device.errors import Busy, CalibrationError, DiffuscopeError, HeadMismatch
from device.head import Bench, Head, refuse_recording
from device.spec import CalibrationTable, InstrumentSpec
from services.instrument.bulletin import Bulletin
from services.instrument.calibrating import Wish
from services.instrument.exam import Exam
from services.instrument.press import NO_VISIT, LiveRequest, Preview
from services.instrument.watchdog import Watchdog
from services.instrument.wizard import Back, Wizard
from services.records.store import Store

log = logging.getLogger(__name__)

PATIENCE_S = 30.0
AIMS_S = 5.0  # since the last live picture was asked for: it may have taken 2 s, and who aims comes again
NO_PREVIEW_S = 1.0  # a page that asks at once again must not keep the computer busy


@dataclass(frozen=True)
class House:
    """What stays the same whoever has the head; `died` is called when nobody can have it any more."""

    spec: InstrumentSpec
    archive: Archive
    store: Store
    bulletin: Bulletin
    clock: Clock
    watchdog: Watchdog
    died: Callable[[], None]


class Owner:
    """Hands the head from the exam to the wizard and back.

    `exam` opens the head with the calibration in force, `bench` without one. Where a calibration is missing or does not
    fit, the wizard has the head, and `needed` says why; the page is served all the same.
    """

    def __init__(self, house: House, exam: Callable[[], Exam], bench: Callable[[], Bench]) -> None:
        self.house = house
        self.needed: DiffuscopeError | None = None
        self.failure: DiffuscopeError | None = None
        self.trouble: DiffuscopeError | None = None  # why the last calibration could not even begin
        self.made: str | None = None  # the calibration that was measured last since the start
        self.wizard: Wizard | None = None
        self._exam: Exam | None = None
        self._open_exam, self._open_bench = exam, bench
        self._lock = Lock()
        self._closing = False
        self._aimed_s = -AIMS_S
        self._begin()

    @property
    def exam(self) -> Exam:
        """The exam; if it does not have the head, the reason why as the error that it is."""
        if self._exam is None:
            raise self.problem or Busy("the instrument is being switched off", "Wait until it is back.")
        return self._exam

    @property
    def problem(self) -> DiffuscopeError | None:
        """Why no picture can be taken now."""
        if self._exam is not None:
            return self._exam.problem
        if self.needed is not None:
            return self.needed
        return Busy("the technician is calibrating the camera", "Wait until the calibration is done.")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found about the calibration while the exam has the head."""
        return self._exam.fitness.findings if self._exam is not None else ()

    @property
    def state(self) -> str:
        """What the exam does; `busy` while it does not have the head."""
        return self._exam.state if self._exam is not None else "busy"

    @property
    def is_idle(self) -> bool:
        """Whether nobody takes a picture, waits for one or aims: then other work may be done."""
        exam = self._exam
        if exam is None:
            return True
        return exam.state == "aim" and self.house.clock.now_s() - self._aimed_s >= AIMS_S

    @property
    def idle_state(self) -> str:
        """`starting` while the exam cannot hand over the head yet, else `idle`: there is no wizard."""
        return "idle" if self._exam is not None and self._exam.ready.is_set() else "starting"

    @property
    def exam_now(self) -> Exam | None:
        """The exam, while it has the head."""
        return self._exam

    @property
    def head(self) -> Head | None:
        """The head as the exam has it; None while it does not."""
        return self._exam.head if self._exam is not None else None

    def preview(self, after: int, wanted: LiveRequest = NO_VISIT) -> Preview | None:
        """The exam's next live picture; while it does not have the head, none ever comes."""
        exam, self._aimed_s = self._exam, self.house.clock.now_s()
        if exam is None:
            self.house.clock.sleep(NO_PREVIEW_S)
            return None
        return exam.preview(after, wanted=wanted)

    def quick(self, id: str) -> bytes | None:
        """The quick look of a press under way."""
        return self._exam.quick(id) if self._exam is not None else None

    def calibrate(self, wish: Wish | Back) -> None:
        """Begin a calibration: the exam finishes what is under way and hands over the head. Busy if one is going on."""
        refuse_recording(self.house.spec)
        with self._lock:
            if self._closing:
                raise Busy("the instrument is being switched off", "Wait until it is back.")
            if self.wizard is not None:
                self.wizard.start(wish)
            else:
                self.trouble = None
                self._take_from_exam()
                self._new_wizard(wish)

    def use(self, id: str) -> None:
        """Put an earlier calibration in force, and give the exam a head that has it."""
        self.house.archive.load(id)  # what cannot be used is said before anything ends
        self.calibrate(Back(id))
        if (wizard := self.wizard) is not None:
            wizard.join(PATIENCE_S)

    def stop(self) -> None:
        """End the calibration under way; the old one stays in force."""
        if (wizard := self.wizard) is not None:
            wizard.stop()
            wizard.join(PATIENCE_S)

    def close(self) -> None:
        """Whoever has the head lets it go, dark."""
        self.house.watchdog.stopping()
        with self._lock:
            self._closing = True
        self.stop()
        if self._exam is not None:
            self._exam.hand_over()
            self.failure = self.failure or self._exam.failure

    def _take_from_exam(self) -> None:
        exam = self.exam
        if not exam.ready.is_set():
            raise Busy("the instrument is still getting ready", "Wait half a minute, then try again.")
        self._exam = None
        words = self.problem
        assert words is not None
        self.house.bulletin.tell("state", state=self.state)
        self.house.bulletin.tell("failed", code=words.code, message=words.message, remedy=words.remedy)
        exam.hand_over()

    def _new_wizard(self, wish: Wish | Back | None) -> None:
        house = self.house
        self.wizard = Wizard(
            house.spec, self._open_bench, house.archive, house.clock, house.watchdog, wish, self._wizard_ended
        )

    def _wizard_ended(self, wizard: Wizard) -> None:
        """The exam has the head again, perhaps with another calibration; until then the wizard is said to have it."""
        with self._lock:
            if wizard.result is not None and wizard.made:
                self.made = wizard.result.calibration.id
            if self._closing:
                return
            self.trouble = wizard.failure
            if wizard.broken or (self.trouble is not None and self.needed is not None):
                self._give_up(self.trouble)
                return
            try:
                self._begin()
            except DiffuscopeError as error:
                self._give_up(error)

    def _give_up(self, error: DiffuscopeError | None) -> None:
        self.failure = error
        self.house.died()

    def _begin(self) -> None:
        try:
            self._exam, self.needed, self.wizard = self._open_exam(), None, None
        except (CalibrationError, HeadMismatch) as error:
            log.warning("the wizard is needed: %s", error)
            self.needed = error
            self._new_wizard(None)


def archive_of(spec: InstrumentSpec, data: Path) -> Path:
    """Where the calibrations of a head are: where its file says, else in the data folder under its name."""
    if spec.calibration is not None:
        return spec.calibration.archive
    return data / "calibrations" / re.sub(r"[^a-z0-9]+", "-", spec.name.lower()).strip("-")


def calibrated(spec: InstrumentSpec, archive: Path) -> InstrumentSpec:
    """The head with what was measured of it; a simulated one needs no archive until something is in it."""
    if spec.calibration is not None or spec.camera.backend == "replay":
        return spec
    if spec.sim is not None and not Archive(archive).ids():
        return spec
    return spec.model_copy(update={"calibration": CalibrationTable(archive=archive)})
