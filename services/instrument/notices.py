"""What the instrument tells pages besides its frames: what stands now, and news when something begins, changes or ends.

A standing thing is a state of the page by its code (web/states.js), with the numbers that its words need. It is looked
for every second, by a thread of its own that only reads: chips, shelf, clock, lease. A page that comes later finds all
of it in the status.
"""

import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from threading import Event, Lock, Thread
from typing import Any

from device.calibration.finding import Finding
from device.clock import Clock
from device.errors import DiffuscopeError, StoreError
from device.head import Chips
from device.spec import BusSpec
from services.health.checks import EARLIEST, LATE_S, PEOPLE_LEFT
from services.instrument.lease import Lease
from services.instrument.owner import Owner
from services.instrument.sending import Sender
from services.instrument.wellbeing import CLOCK_WAS_SET
from services.records.people import People
from services.records.underway import Lost

log = logging.getLogger(__name__)

EVERY_S = 1.0
WARM_C = 5.0  # below the limit: from here on it is said
SHADE_S = 300.0  # the words say five minutes
BATTERY_PEOPLE = 60  # whom a full battery lasts: a guess, three hours of three minutes each; no battery is chosen yet
JUMPED_S = 3600.0  # between the date and the time that was seen to pass: no clock drifts so far in a day
Standing = dict[str, dict[str, Any]]


@dataclass
class Hot:
    """Since when the head has been too warm."""

    since_s: float | None = None

    def wait_s(self, now_s: float) -> int:
        """What is left of its minutes in the shade; they begin anew if that was not enough."""
        self.since_s = now_s if self.since_s is None else self.since_s
        return int(SHADE_S - (now_s - self.since_s) % SHADE_S)


class Notices:
    """Looks at what stands, and tells the bulletin what has changed since it looked last."""

    def __init__(self, owner: Owner, people: People, lease: Lease, sender: Sender | None = None) -> None:
        self._owner, self._people, self.lease, self.sender = owner, people, lease, sender
        self._clock: Clock = owner.house.clock
        self._began = (self._clock.wall(), self._clock.now_s())
        self._hot, self._told, self._held = Hot(), Standing(), lease.holder
        self._lock, self._enough = Lock(), Event()
        self._thread: Thread | None = None

    def begin(self) -> None:
        """Look every second from now on."""
        self._enough.clear()
        self._thread = Thread(target=self._watch, name="notices", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._enough.set()
        if self._thread is not None:
            self._thread.join()

    def _watch(self) -> None:
        while not self._enough.wait(EVERY_S):
            self.look()

    def standing(self) -> Standing:
        """Everything that stands now, by code."""
        found: Standing = {}
        for part in (
            self._store, self._head, self._calibration, self._date, self._making, self._side, self._sending,
        ):  # fmt: skip
            try:
                found.update(part())
            except DiffuscopeError as error:  # who asks that part for work is told by it
                log.debug("cannot be looked at: %s", error)
        return found

    def lost(self) -> list[Lost]:
        """Presses that a power cut ended, and that nobody has taken again since."""
        exam = self._owner.exam_now
        if exam is None:
            return []
        exam.underway.forget(self._is_over)
        return list(exam.underway.lost)

    def look(self) -> None:
        """Tell what began, changed or is over."""
        with self._lock:
            now, bulletin = self.standing(), self._owner.house.bulletin
            for code, facts in now.items():
                if self._told.get(code) is None or _told(self._told[code]) != _told(facts):
                    bulletin.tell("notice", code=code, **facts)
            for code in self._told.keys() - now.keys():
                bulletin.tell("notice", code=code, over=True)
            self._told = now
            if (held := self.lease.holder) != self._held:  # every screen asks at once whether it may take pictures
                self._held = held
                bulletin.tell("notice", code="link.other", over=held is None)

    def _store(self) -> Standing:
        store = self._owner.house.store
        if store.space_left() == 0:
            return {"store.full": {}}
        people = store.people_left(len(self._people.protocol.slots))
        return {"store.low": {"n": people}} if people < PEOPLE_LEFT else {}

    def _head(self) -> Standing:
        head = self._owner.head
        if head is None or head.spec.bus is None:
            return {}
        return dict([*self._warmth(head.chips, head.spec.bus), *_charge(head.chips, head.spec.bus)])

    def _warmth(self, chips: Chips, limits: BusSpec) -> Iterator[tuple[str, dict[str, Any]]]:
        if chips.thermometer is None:
            return
        head_c = chips.thermometer.read_c()
        if head_c > limits.warmest_c:
            yield "heat.hot", {"wait_s": self._hot.wait_s(self._clock.now_s())}
            return
        self._hot = Hot()
        if head_c > limits.warmest_c - WARM_C:
            yield "heat.warm", {}

    def _calibration(self) -> Standing:
        old = [one for one in self._owner.findings if is_old(one)]
        return {"cal.old": {"n": int(old[0].value)}} if old else {}

    def _date(self) -> Standing:
        """Before there was such an instrument, before the newest capture, or far from what was seen to pass."""
        now = self._clock.wall()
        newest = self._newest()
        drifted_s = (now - self._began[0]).total_seconds() - (self._clock.now_s() - self._began[1])
        jumped = abs(drifted_s) > JUMPED_S and not CLOCK_WAS_SET.exists()
        if now >= max(EARLIEST, newest or EARLIEST) and not jumped:
            return {}
        return {"clock.wrong": {"date": now.astimezone().date().isoformat()}}

    def _newest(self) -> datetime | None:
        try:
            newest = self._owner.house.store.captures(1)
        except StoreError:
            return None
        return newest[0].taken_at.astimezone(UTC) if newest else None

    def _making(self) -> Standing:
        exam = self._owner.exam_now
        return {"make.slow": {}} if exam is not None and exam.progress.late_s > LATE_S else {}

    def _side(self) -> Standing:
        asked = self._people.asked_side()
        return {} if asked is None else {"eye.side": asdict(asked)}

    def _sending(self) -> Standing:
        return self.sender.standing() if self.sender is not None else {}

    def _is_over(self, one: Lost) -> bool:
        """Whether its slot has a picture, or its visit has ended."""
        if one.visit is None or one.slot is None:
            return False
        try:
            visit = self._people.get(one.visit)
        except DiffuscopeError:
            return True
        slot = visit.slots.get(one.slot)
        return visit.finished_at is not None or slot is None or len(slot.taken) > one.tries


def is_old(one: Finding) -> bool:
    """Whether a finding is what `cal.old` says: one that is too old refuses, one of the future is another matter."""
    return one.name == "age" and one.hint and one.limit > 0


def _charge(chips: Chips, limits: BusSpec) -> Iterator[tuple[str, dict[str, Any]]]:
    if chips.battery is None:
        return
    fraction = chips.battery.read().fraction
    people = int((fraction - limits.emptiest) * BATTERY_PEOPLE)
    if fraction < limits.emptiest:
        yield "batt.empty", {}
    elif people < PEOPLE_LEFT:
        yield "batt.low", {"n": people}


def _told(facts: dict[str, Any]) -> dict[str, Any]:
    """What makes it news: a page counts the seconds by itself."""
    return {name: value for name, value in facts.items() if name != "wait_s"}
