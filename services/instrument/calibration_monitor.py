"""Calibration monitor: check between captures, from stored ones, whether the calibration in force fits the head.

The monitor checks the latest captures of the store at the start, then each new capture. A press interrupts a check,
which is repeated later. At every press the findings, with the age of the calibration, decide whether it is refused.
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable
from datetime import UTC, datetime

from device.calibration.archive import CURRENT
from device.calibration.monitoring.finding import Finding
from device.calibration.monitoring.head_check import (
    RECENT_CAPTURES,
    CaptureAssessment,
    ExposurePair,
    ReportedRefraction,
    assess_capture,
    check,
    raise_on_failure,
)
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import CalibrationError, DiffuscopeError, FrameError, StoreError
from device.head import Head
from device.optics.lit_angle import has_sharp_edge
from device.recon.assessment.frame_quality import shows_eye
from device.recon.assessment.psf_match_any_refraction import PsfMatchTest
from device.recon.estimation.refraction.estimator import RefractionEstimator
from services.errors import Busy
from services.imaging.picture_files import read_raw_tiff
from services.instrument.events import EventBus
from services.instrument.watchdog import Watchdog
from services.records.capture import Capture
from services.records.capture_store import CaptureStore

log = logging.getLogger(__name__)

CHECKED_CAPTURES = 2 * RECENT_CAPTURES  # latest captures checked at the start; some are not conclusive
REFRACTION_CAPTURES = 200  # latest captures whose reported refraction is read


class CalibrationMonitor:
    """Findings about the calibration of one head. `start`, `add` and `step` run on the thread that owns the head.

    `findings` and `refusal` read immutable tuples, which that thread replaces: they may be called from any thread.
    """

    def __init__(
        self,
        head: Head,
        store: CaptureStore,
        event_bus: EventBus,
        clock: Clock,
        is_pressed: Callable[[], bool],
        watchdog: Watchdog,
    ) -> None:
        self._head, self._store, self._event_bus, self._clock = head, store, event_bus, clock
        self._is_pressed, self._watchdog = is_pressed, watchdog
        self._witness: PsfMatchTest | None = None
        self._pending: deque[Capture] = deque(maxlen=CHECKED_CAPTURES)
        self._sights: tuple[CaptureAssessment, ...] = ()
        self._refractions: tuple[ReportedRefraction, ...] = ()
        self._published: tuple[str, ...] = ()

    def start(self, refractor: RefractionEstimator | None) -> None:
        """Queue the latest stored captures with the calibration in force; no-op for a recording, which is not checked.

        Without a `refractor` the stored PSF is not tested.
        """
        if self._head.kind == "recording":
            return
        self._witness = None if refractor is None else PsfMatchTest(refractor, has_sharp_edge(self._head.spec))
        try:
            taken = list(
                captures_with_calibration(self._store, self._head.calibration.id, in_force_since(self._head.spec))
            )
        except StoreError as error:  # the first capture reports the error of the store
            log.warning("latest captures cannot be read: %s", error)
            return
        self._add_refractions(taken)
        self._pending.extend(taken[-CHECKED_CAPTURES:])

    def add(self, capture: Capture) -> None:
        """Queue a stored capture for its check; no-op for a recording."""
        if self._head.kind != "recording":
            self._add_refractions([capture])
            self._pending.append(capture)

    def _add_refractions(self, captures: Iterable[Capture]) -> None:
        self._refractions = (*self._refractions, *reported_refractions(captures))[-REFRACTION_CAPTURES:]

    @property
    def has_pending(self) -> bool:
        """Whether a capture is queued."""
        return bool(self._pending)

    def step(self) -> None:
        """Check the oldest queued capture; a press interrupts the check and leaves the capture in the queue.

        A capture that cannot be read is skipped.
        """
        try:
            frames = exposures(self._store, self._pending[0], self._yield_to_press)
            sight = assess_capture(
                self._head.calibration, self._head.provenance, self._witness, frames, self._yield_to_press
            )
            self._sights = (*self._sights, sight)[-CHECKED_CAPTURES:]
        except Busy:
            return
        except DiffuscopeError as error:  # a damaged file or another sensor: not conclusive
            log.warning("capture %s cannot be used to check the calibration: %s", self._pending[0].id, error)
        self._pending.popleft()
        self._publish_changes()

    def _yield_to_press(self) -> None:
        self._watchdog.beat()  # on a busy computer a check may outlast the watchdog interval
        if self._is_pressed():
            raise Busy("a press waits")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The current findings, empty for a recording; may be read from any thread."""
        head = self._head
        if head.kind == "recording":
            return ()
        return check(head.calibration, head.provenance, self._sights, self._refractions, self._clock.wall())

    def refusal(self) -> CalibrationError | None:
        """Return CalibrationExpired if the calibration is too old, CalibrationStale if another finding fails, or None.

        May be called from any thread.
        """
        try:
            raise_on_failure(self.findings)
        except CalibrationError as error:
            return error
        return None

    def _publish_changes(self) -> None:
        """Publish the findings when the set of failed ones has changed."""
        failed = tuple(finding.name for finding in self.findings if not finding.ok)
        if failed != self._published:
            self._published = failed
            self._event_bus.publish("calibration", findings=self.findings)


def in_force_since(spec: InstrumentSpec) -> datetime:
    """Return the time at which the calibration was put in force (UTC); 1970-01-01 for a head without an archive."""
    if spec.calibration is None:
        return datetime.fromtimestamp(0, UTC)
    return datetime.fromtimestamp((spec.calibration.archive / CURRENT).stat().st_mtime, UTC)


def captures_with_calibration(store: CaptureStore, calibration_id: str, since: datetime) -> Iterable[Capture]:
    """Return, oldest first, the captures with this calibration since `since`, of the latest REFRACTION_CAPTURES."""
    return (
        capture
        for capture in reversed(store.captures(REFRACTION_CAPTURES))
        if capture.calibration_id == calibration_id and capture.taken_at >= since
    )


def reported_refractions(captures: Iterable[Capture]) -> list[ReportedRefraction]:
    """Return the refraction of each capture that shows an eye, and whose report has one with numbers."""
    found = []
    for capture in filter(has_eye, captures):
        report = capture.report.refraction_dpt or {}
        sphere, *edge = (report.get(name) for name in ("sphere", "field_deg", "field_deg_sd"))
        if isinstance(sphere, int | float):
            diameter_deg, sd_deg = (float(value) if isinstance(value, int | float) else 0.0 for value in edge)
            found.append(ReportedRefraction(capture.taken_at, -float(sphere), diameter_deg, sd_deg))
    return found


def has_eye(capture: Capture) -> bool:
    """Return whether a capture shows an eye through its whole pupil, by the figures of its verdict; True without one.

    Its code does not show that: on the last try it is `shot.poor`, whatever the cause.
    """
    verdict = capture.report.verdict
    return verdict is None or shows_eye(verdict.numbers)


def exposures(store: CaptureStore, capture: Capture, between: Callable[[], None] = lambda: None) -> ExposurePair:
    """Return the lit and dark frame of a stored capture; `between` is called after each file and may raise to stop.

    Raises RecordNotFound, StoreDamaged (SHA-256) or FrameError.
    """
    lit, metadata = read_raw_tiff(store.read(capture.id, "raw.tiff"))
    between()
    dark, _ = read_raw_tiff(store.read(capture.id, "dark.tiff"))
    between()
    if metadata.exposure_s is None:
        raise FrameError(f"the raw frame of {capture.id} has no exposure time")
    return ExposurePair(capture.taken_at, lit, dark, float(metadata.exposure_s), has_eye(capture))
