"""Event bus from the instrument to the open pages: numbered events in a ring buffer, for server-sent events."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Mapping
from dataclasses import dataclass
from threading import Lock

from services.instrument.wakeups import Wakeups

BUFFER_LENGTH = 100  # length of the ring buffer: events that a reconnected page can still receive
BEAT_S = 1.0


@dataclass(frozen=True)
class Event:
    """Event: number, kind and data; services/http/schemas/events.py declares what is sent to the page for each kind."""

    number: int
    kind: str
    data: Mapping[str, object]


class EventBus:
    """Event bus with any number of asynchronous subscribers; `publish` is thread-safe.

    The mutex `_lock` guards `_events` and `_number`.
    """

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=BUFFER_LENGTH)
        self._wakeups = Wakeups()
        self._lock = Lock()
        self._number = 0
        self._closed = False

    def publish(self, kind: str, **data: object) -> None:
        """Append an event and wake every subscriber; callable from any thread."""
        with self._lock:
            self._number += 1
            self._events.append(Event(self._number, kind, data))
        self._wakeups.wake()

    def close(self) -> None:
        """End the iteration of every subscriber, so that the server can stop."""
        self._closed = True
        self._wakeups.wake()

    @property
    def last_number(self) -> int:
        """The number of the latest event; 0 before the first."""
        return self._number

    @property
    def history(self) -> tuple[Event, ...]:
        """The events in the ring buffer, the oldest first."""
        with self._lock:
            return tuple(self._events)

    async def subscribe(self, after: int | None = None) -> AsyncGenerator[Event]:
        """Yield the events after number `after` (None: from now on) until `close`.

        A heartbeat (event `beat`, number 0) comes first and after each second without an event. If `after` exceeds the
        latest number, the page was connected before a restart: all events in the buffer follow.
        """
        last = self.last_number
        seen = last if after is None else after if after <= last else 0
        with self._wakeups.subscribed() as wakeup:
            yield Event(0, "beat", {"number": seen})
            while not self._closed:
                wakeup.clear()
                with self._lock:
                    new_events = [event for event in self._events if event.number > seen]
                for event in new_events:
                    seen = event.number
                    yield event
                try:
                    await asyncio.wait_for(wakeup.wait(), BEAT_S)
                except TimeoutError:
                    yield Event(0, "beat", {"number": seen})
