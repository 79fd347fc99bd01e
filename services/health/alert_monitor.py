"""Alert monitor: publishes each alert on the event bus when it begins, changes or ends.

A thread reads the status of the instrument, capture store, clock, control lease and upload queue once per second. A
page that connects later reads all active alerts from the status.
"""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Protocol

from device.clock import Clock
from device.errors import DiffuscopeError, StoreError, StoreReadOnly
from services.health import alerts
from services.health.alerts import Alert, AlertCode, CoolingTimer
from services.health.clock_request import needs_time
from services.health.clock_source import clock_state
from services.health.instrument_status import InstrumentStatus
from services.periodic_worker import PeriodicWorker
from services.records.capture_store import CaptureStore
from services.records.upload_queue import UploadQueue
from services.records.visit_repository import VisitRepository

log = logging.getLogger(__name__)

POLL_S = 1.0


class Publish(Protocol):
    """Function that publishes one event to every open page, with the keyword arguments as its fields."""

    def __call__(self, kind: str, **data: object) -> None:
        """Publish one event of that kind."""


@dataclass(frozen=True)
class AlertSources:
    """What the alerts are read from; `upload_queue` is None if no receiver is set up.

    `read_status` returns the status of the instrument; `lease_holder` the public name of the screen that holds the
    control lease, None if no screen holds it. `system`: root of the file system.
    """

    read_status: Callable[[], InstrumentStatus]
    store: CaptureStore
    visits: VisitRepository
    lease_holder: Callable[[], str | None]
    upload_queue: UploadQueue | None = None
    system: Path = Path("/")


class AlertMonitor:
    """Monitor of the alerts; a thread publishes the differences between two readings on the event bus."""

    def __init__(self, sources: AlertSources, clock: Clock, publish: Publish) -> None:
        self._sources, self._clock, self._publish = sources, clock, publish
        self._began = (clock.wall(), clock.now_s())
        self._cooling = CoolingTimer()
        self._holder = sources.lease_holder()
        self._published: dict[AlertCode, Alert] = {}
        self._lock = Lock()
        self._worker = PeriodicWorker("notices", self.publish_changes, POLL_S, "alerts not readable")

    def begin(self) -> None:
        """Start the thread, which reads once per second."""
        self._worker.begin()

    def close(self) -> None:
        """Stop the thread."""
        self._worker.close()

    def active_alerts(self) -> list[Alert]:
        """Return the active alerts; a part that cannot be read adds none."""
        found: list[Alert] = []
        for part in (self._of_space, self._of_instrument, self._of_date, self._of_laterality, self._of_uploads):
            try:
                found.extend(part())
            except DiffuscopeError as error:  # the part reports its error to its own callers
                log.debug("alert source not readable: %s", error)
        return found

    def publish_changes(self) -> bool:
        """Read the alerts once, and publish an event `notice` for each difference from the previous reading.

        An alert that ended has `over=True`. `link.other` is published when the holder of the control lease changes.
        Return False: the next reading waits for its time.
        """
        with self._lock:
            now = {alert.code: alert for alert in self.active_alerts()}
            for code, alert in now.items():
                before = self._published.get(code)
                if before is None or _without_countdown(before) != _without_countdown(alert):
                    self._publish("notice", **alert.facts())
            for code in self._published.keys() - now.keys():
                self._publish("notice", code=code, over=True)
            self._published = now
            if (holder := self._sources.lease_holder()) != self._holder:  # each screen then requests its control state
                self._holder = holder
                self._publish("notice", code="link.other", over=holder is None)
        return False

    def _of_space(self) -> Iterator[Alert]:
        store = self._sources.store
        slots = self._sources.visits.programme.slots
        if isinstance(store.refusal, StoreReadOnly):  # the problem of the next live picture says so
            return iter(())
        return alerts.space_alerts(store.space.captures_left(), store.space.visits_left(len(slots)))

    def _of_instrument(self) -> Iterator[Alert]:
        status = self._sources.read_status()
        head_c = status.head_c  # an error of a reading is reported by the health checks
        charge_ratio = status.battery
        if head_c is not None and not isinstance(head_c, DiffuscopeError):
            yield from alerts.heat_alerts(head_c, status.warmest_c, self._cooling, self._clock.now_s())
        if charge_ratio is not None and not isinstance(charge_ratio, DiffuscopeError):
            yield from alerts.battery_alerts(charge_ratio, status.emptiest)
        yield from alerts.calibration_alerts(status.findings)
        yield from alerts.lateness_alerts(status.late_s)

    def _of_date(self) -> Iterator[Alert]:
        now = self._clock.wall()
        now_s = self._clock.now_s()
        drift_s = (now - self._began[0]).total_seconds() - (now_s - self._began[1])
        is_synchronised = clock_state(self._sources.system) in ("network", "browser")
        return alerts.date_alerts(now, self._newest(), drift_s, is_synchronised, needs_time(self._sources.system))

    def _newest(self) -> datetime | None:
        """Return the time of the newest capture; None without one, or if the store cannot be read."""
        try:
            newest = self._sources.store.captures(1)
        except StoreError:
            return None
        return newest[0].taken_at.astimezone(UTC) if newest else None

    def _of_laterality(self) -> Iterator[Alert]:
        return alerts.laterality_alerts(self._sources.visits.pictures.laterality_question())

    def _of_uploads(self) -> Iterator[Alert]:
        queue = self._sources.upload_queue
        return iter(()) if queue is None else alerts.upload_alerts(queue.status())


def _without_countdown(alert: Alert) -> Alert:
    """Return an alert without `wait_s`, which the page counts down locally: its change is not published."""
    return replace(alert, wait_s=None)
