"""Rate limit of log records, for the loggers that strangers can make write: asyncio and uvicorn."""

import logging
from threading import Lock

from device.clock import Clock

LOGGER_NAMES = ("asyncio", "uvicorn.error")
RECORDS = 30
INTERVAL_S = 60.0


class LogRateLimit(logging.Filter):
    """Log filter that passes at most `records` records per `interval_s` seconds, and counts the others.

    The first record of the next interval names the number of the suppressed ones. The mutex `_lock` guards every field;
    thread-safe.
    """

    def __init__(self, clock: Clock, records: int = RECORDS, interval_s: float = INTERVAL_S) -> None:
        super().__init__()
        self._clock, self._records, self._interval_s = clock, records, interval_s
        self._lock = Lock()
        self._begin_s = clock.now_s()
        self._passed = self._suppressed = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged."""
        with self._lock:
            now_s = self._clock.now_s()
            suppressed = 0
            if now_s - self._begin_s >= self._interval_s:
                suppressed = self._suppressed
                self._suppressed = 0
                self._begin_s = now_s
                self._passed = 0
            self._passed += 1
            if self._passed > self._records:
                self._suppressed += 1
                return False
        if suppressed:
            record.msg = f"{record.getMessage()} (and {suppressed} suppressed messages before it)"
            record.args = ()
        return True
