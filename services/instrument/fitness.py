"""Whether the calibration in force still fits the head: kept captures are looked at, one by one, while nobody presses.

At the start the last captures of the shelf are looked at, then each new one after it was kept. A press that comes in
between ends the look at once, and it is begun again later. Age is asked of the clock at every press.
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from typing import Any

from device.calibration.archive import CURRENT
from device.calibration.check import LAST, Exposures, Sight, check, look, refuse
from device.calibration.finding import Finding
from device.clock import Clock
from device.errors import Busy, DiffuscopeError, StoreError
from device.head import Head
from device.recon.refraction import Refractor
from device.recon.witness import Witness
from device.spec import InstrumentSpec
from device.values import Capture
from services.instrument.bulletin import Bulletin
from services.instrument.watchdog import Watchdog
from services.records.picture import read_raw_tiff
from services.records.store import Store

log = logging.getLogger(__name__)

LOOKED_AT = 2 * LAST  # of the shelf's last captures, at the start: some of them say nothing
ASKED = 200  # captures whose refraction is in their report


class Fitness:
    """What is known about one head's calibration. `step` and `begin` belong to the thread that owns the head."""

    def __init__(
        self, head: Head, store: Store, bulletin: Bulletin, clock: Clock, pressed: Callable[[], bool],
        watchdog: Watchdog,
    ) -> None:  # fmt: skip
        self._head, self._store, self._bulletin, self._clock = head, store, bulletin, clock
        self._pressed, self._watchdog = pressed, watchdog
        self._witness: Witness | None = None
        self._waiting: deque[Capture] = deque(maxlen=LOOKED_AT)
        self._sights: deque[Sight] = deque(maxlen=LOOKED_AT)
        self._spheres_dpt: deque[tuple[datetime, float]] = deque(maxlen=ASKED)
        self._told: tuple[str, ...] = ()

    def begin(self, refractor: Refractor | None) -> None:
        """Look at what is on the shelf, with what the exam has planned; a recording is not calibrated, so not asked."""
        if self._head.kind == "recording":
            return
        self._witness = Witness(refractor) if refractor is not None else None
        try:
            taken = list(taken_with(self._store, self._head.calibration.id, in_force_since(self._head.spec)))
        except StoreError as error:  # the shelf says so itself, at the first press
            log.warning("the last captures cannot be read: %s", error)
            return
        self._spheres_dpt.extend(spheres_dpt(taken))
        self._waiting.extend(taken[-LOOKED_AT:])

    def kept(self, capture: Capture) -> None:
        """A capture to look at when there is time."""
        if self._head.kind != "recording":
            self._spheres_dpt.extend(spheres_dpt([capture]))
            self._waiting.append(capture)

    @property
    def due(self) -> bool:
        """Whether a capture waits to be looked at."""
        return bool(self._waiting)

    def step(self) -> None:
        """Look at the capture that waits longest; a press in between puts it off."""
        try:
            seen = exposures(self._store, self._waiting[0], self._give_way)
            self._sights.append(
                look(self._head.calibration, self._head.provenance, self._witness, seen, self._give_way)
            )
        except Busy:
            return
        except DiffuscopeError as error:  # damaged on the shelf, or of another sensor: it says nothing about the head
            log.warning("%s tells nothing about the calibration: %s", self._waiting[0].id, error)
        self._waiting.popleft()
        self._tell()

    def _give_way(self) -> None:
        self._watchdog.beat()  # on a busy computer a look may last longer than systemd waits for a sign of life
        if self._pressed():
            raise Busy("somebody presses")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All that is known now; any thread may ask."""
        head = self._head
        if head.kind == "recording":
            return ()
        sights, spheres = tuple(self._sights), tuple(self._spheres_dpt)
        return check(head.calibration, head.provenance, sights, spheres, self._clock.wall())

    def refuse(self) -> None:
        """CalibrationOld or CalibrationStale if no picture should be taken with this calibration."""
        refuse(self.findings)

    def _tell(self) -> None:
        """News for the page when something was found, or is well again."""
        wrong = tuple(one.name for one in self.findings if not one.ok)
        if wrong != self._told:
            self._told = wrong
            self._bulletin.tell("calibration", findings=shown(self.findings))


def shown(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Findings as JSON; a value is rounded as people read it."""
    return [
        {
            "name": one.name, "ok": one.ok, "hint": one.hint, "value": float(f"{one.value:.4g}"),
            "limit": float(f"{one.limit:.4g}"), "unit": one.unit, "remedy": one.remedy,
        }
        for one in findings
    ]  # fmt: skip


def in_force_since(spec: InstrumentSpec) -> datetime:
    """When the calibration was put in force: a technician who goes back to it has seen that it fits again."""
    if spec.calibration is None:
        return datetime.fromtimestamp(0, UTC)
    return datetime.fromtimestamp((spec.calibration.archive / CURRENT).stat().st_mtime, UTC)


def taken_with(store: Store, calibration_id: str, since: datetime) -> Iterable[Capture]:
    """The shelf's last captures with this calibration, the oldest first."""
    return (
        one for one in reversed(store.captures(ASKED)) if one.calibration_id == calibration_id and one.taken_at >= since
    )


def spheres_dpt(captures: Iterable[Capture]) -> list[tuple[datetime, float]]:
    """The mean sphere that each report found, positive for myopia, and when."""
    spheres = ((one.taken_at, (one.report.get("refraction_dpt") or {}).get("sphere")) for one in captures)
    return [(taken_at, -sphere) for taken_at, sphere in spheres if sphere is not None]


def exposures(store: Store, capture: Capture, between: Callable[[], None] = lambda: None) -> Exposures:
    """The frames of a capture, read back and verified."""
    lit, facts = read_raw_tiff(store.read(capture.id, "raw.tiff"))
    between()
    dark, _ = read_raw_tiff(store.read(capture.id, "dark.tiff"))
    between()
    return Exposures(capture.taken_at, lit, dark, float(facts["exposure_s"]))
