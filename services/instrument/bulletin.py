"""What happens, told to every open page as it happens: one ring of numbered events, any thread may tell."""

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from threading import Lock
from typing import Any

RING = 100  # events that a page which was away for a moment can still catch up on
BEAT_S = 1.0


@dataclass(frozen=True)
class Event:
    """One thing that happened: its number, its kind, and its data for the page."""

    number: int
    kind: str
    data: dict[str, Any]

    def as_sse(self) -> str:
        """The event as server-sent-event text; a heartbeat has no number, so that it is never replayed."""
        mark = f"id: {self.number}\n" if self.number else ""
        return f"{mark}event: {self.kind}\ndata: {json.dumps(self.data)}\n\n"


class Bulletin:
    """A board on which the instrument writes, and from which pages read at their own pace."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque(maxlen=RING)
        self._readers: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._lock = Lock()
        self._number = 0
        self._closed = False

    def tell(self, kind: str, **data: Any) -> None:
        """Write an event and wake every reader; from any thread."""
        with self._lock:
            self._number += 1
            self._events.append(Event(self._number, kind, data))
        self._wake()

    def close(self) -> None:
        """End every reader's story, so that the server can stop."""
        self._closed = True
        self._wake()

    def _wake(self) -> None:
        with self._lock:
            for loop, ring in self._readers:
                if not loop.is_closed():
                    loop.call_soon_threadsafe(ring.set)

    @property
    def last_number(self) -> int:
        """The number of the newest event."""
        return self._number

    async def follow(self, after: int | None = None) -> AsyncIterator[Event]:
        """Events after number `after` (None: from now on), and a `beat` whenever a second brings nothing.

        A page that remembers more than was ever told was here before a restart: to it, everything is new.
        """
        last = self.last_number
        seen = last if after is None else after if after <= last else 0
        ring = asyncio.Event()
        reader = (asyncio.get_running_loop(), ring)
        with self._lock:
            self._readers.add(reader)
        try:
            yield Event(0, "beat", {"number": seen})
            while not self._closed:
                ring.clear()
                with self._lock:
                    fresh = [event for event in self._events if event.number > seen]
                for event in fresh:
                    seen = event.number
                    yield event
                try:
                    await asyncio.wait_for(ring.wait(), BEAT_S)
                except TimeoutError:
                    yield Event(0, "beat", {"number": seen})
        finally:
            with self._lock:
                self._readers.discard(reader)
