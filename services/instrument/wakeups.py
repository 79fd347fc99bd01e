"""Wake-up of coroutines by changes that other threads make."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock


class Wakeups:
    """asyncio events of the coroutines that wait for a change. The mutex `_lock` guards `_subscribers`; thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._subscribers: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    @contextmanager
    def subscribed(self) -> Iterator[asyncio.Event]:
        """Return an event that each `wake` sets until the exit of the context, for the coroutine that calls this."""
        wakeup = asyncio.Event()
        subscriber = (asyncio.get_running_loop(), wakeup)
        with self._lock:
            self._subscribers.add(subscriber)
        try:
            yield wakeup
        finally:
            with self._lock:
                self._subscribers.discard(subscriber)

    def wake(self) -> None:
        """Set the event of every subscriber; callable from any thread."""
        with self._lock:
            for loop, wakeup in self._subscribers:
                if not loop.is_closed():
                    loop.call_soon_threadsafe(wakeup.set)
