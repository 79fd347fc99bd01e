"""Finished visits go to the receiver by themselves, one after the other, while nobody is examined.

A thread of its own: it looks each second whether somebody waits, whether it is time, and whether nobody takes pictures
or aims. It reads the shelf and writes down only what became of it.
"""

import logging
import random
from collections.abc import Callable
from threading import Event, Thread
from typing import Any

from device.clock import Clock
from device.errors import (
    Busy,
    DiffuscopeError,
    NotKept,
    SendLocked,
    SendRejected,
    SendUnlike,
    SendUnreachable,
    SendUntrusted,
    StoreDamaged,
    StoreError,
)
from services.instrument.carrier import Carrier, Parcel
from services.instrument.exporting import exported, folder_name, zipped
from services.instrument.visits_api import shown_visit
from services.records.outbox import Outbox, Waiting
from services.records.people import People
from services.records.store import Store

log = logging.getLogger(__name__)

LOOK_S = 1.0
FIRST_S, LAST_S = 60.0, 3600.0  # between tries: doubled from one to the other
MOST_DOUBLED = 10  # a link may fail for months
SPREAD = 0.2  # of a wait, by chance: after a power cut not every device of a district asks at once
GLANCE_S = 0.1
HUNG_UP_S = 20.0  # no receiver waits longer for the next piece
OWN = (SendRejected, SendUnlike, StoreDamaged, NotKept)  # what no other visit suffers from, and no time mends
PARKED = frozenset(kind.code for kind in OWN)


class Sender:
    """Sends what waits; `is_idle` says whether nobody needs the instrument now."""

    def __init__(
        self, outbox: Outbox, pack: Callable[[str], Parcel], carrier: Carrier, is_idle: Callable[[], bool],
        clock: Clock, chance: Callable[[], float] = random.random,
    ) -> None:  # fmt: skip
        self.outbox = outbox
        self._pack, self._carrier, self._is_idle, self._clock, self._chance = pack, carrier, is_idle, clock, chance
        self._fails, self._due_s = 0, 0.0
        self._closing, self._wake = Event(), Event()
        self._thread: Thread | None = None

    def begin(self) -> None:
        """Send by itself from now on."""
        self._closing.clear()
        self._thread = Thread(target=self._send, name="sending", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Send no more: a parcel under way is given up, and sent again at the next start."""
        self._closing.set()
        self._wake.set()
        self._carrier.abort()
        if self._thread is not None:
            self._thread.join(timeout=5)

    def try_now(self, visit: str | None = None) -> None:
        """Somebody says that what kept one (None: all) from being sent is mended."""
        self.outbox.forget(visit)
        self._fails, self._due_s = 0, 0.0
        self._wake.set()

    @property
    def wait_s(self) -> float:
        """Until the next try, where it has been put off."""
        return max(0.0, self._due_s - self._clock.now_s())

    def counts(self) -> dict[str, int]:
        """How many of today were sent, and how many wait."""
        today = self._clock.wall().astimezone().date().isoformat()
        return {"sent": self.outbox.sent(today), "waiting": self.outbox.trouble().waiting}

    def in_need(self) -> tuple[int, int]:
        """How many wait, and how many of them need somebody: all, if the thread that sends has ended by itself."""
        trouble, thread = self.outbox.trouble(), self._thread
        ended = thread is not None and not thread.is_alive() and not self._closing.is_set()
        return trouble.waiting, trouble.waiting if ended else trouble.stuck

    def standing(self) -> dict[str, dict[str, Any]]:
        """What pages are told: who could not be sent for a reason that does not pass, and who waits for the link."""
        trouble = self.outbox.trouble()
        found: dict[str, dict[str, Any]] = {}
        if trouble.stuck_since is not None:
            since = trouble.stuck_since.astimezone().date().isoformat()
            found["send.stuck"] = {"n": trouble.stuck, "date": since}
        if trouble.failing:
            found["send.waiting"] = {"n": trouble.waiting - trouble.stuck}
        return found

    def step(self) -> bool:
        """Send the one that was finished first, if now is the time for it; whether it was tried."""
        if self.wait_s > 0 or not self._is_idle():
            return False
        first = self.outbox.waiting(1, parked=PARKED)
        if not first:
            return False
        try:
            receipt = self._carrier.deliver(self._pack(first[0].visit), self._pause)
        except Busy:  # nothing went wrong: somebody is examined, or it was opened again
            return False
        except (SendUnreachable, SendUntrusted, SendLocked) as error:
            if not self._closing.is_set():
                self._fail(first[0], error, self.outbox.waiting(parked=PARKED))
                self._put_off()
        except OWN as error:
            self._fail(first[0], error, first)
        else:
            self._fails = 0
            self.outbox.arrived(first[0], receipt)
            log.info("sent, and seen at the receiver by its %s", receipt.confirmed, extra={"about": first[0].visit})
        return True

    def _fail(self, one: Waiting, error: DiffuscopeError, which: list[Waiting]) -> None:
        log.warning("not sent: %s", error, extra={"code": error.code, "about": one.visit})
        self.outbox.failed(which, error)

    def _put_off(self) -> None:
        wait_s = min(FIRST_S * 2.0**self._fails, LAST_S)
        self._fails = min(self._fails + 1, MOST_DOUBLED)
        self._due_s = self._clock.now_s() + wait_s * (1.0 - SPREAD * self._chance())

    def _pause(self) -> None:
        """Between two pieces of a parcel: whoever is examined goes before it; Busy if that takes long."""
        until_s = self._clock.now_s() + HUNG_UP_S
        while not self._closing.is_set():
            if self._is_idle():
                return
            if self._clock.now_s() > until_s:
                break
            self._closing.wait(GLANCE_S)
        raise Busy("somebody is examined, or the instrument is being switched off")

    def _send(self) -> None:
        while not self._closing.is_set():
            try:
                tried = self.step()
            except StoreError as error:  # busy, or out of room: it passes, or the shelf says so elsewhere
                log.warning("the outbox cannot be asked: %s", error, extra={"code": error.code})
                tried = False
            if not tried:
                self._wake.wait(LOOK_S)
                self._wake.clear()


def packer(store: Store, people: People) -> Callable[[str], Parcel]:
    """How a visit becomes a parcel: what an export has of it, without what changes by itself from day to day."""

    def pack(id: str) -> Parcel:
        visit = people.get(id)
        if visit.finished_at is None:
            raise Busy(f"{visit.number} was opened again")
        shown = shown_visit(visit, people)
        del shown["undo_until"]
        name = folder_name(visit)
        return Parcel(name, zipped(name, exported(store, visit, shown), visit.begun_at))

    return pack
