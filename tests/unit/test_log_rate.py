"""Rate limit of log records that clients can cause."""

import logging

import pytest

from device.clock import VirtualClock
from services.http.log_rate import LogRateLimit


def test_records_beyond_the_rate_are_counted_in_the_next_interval(caplog: pytest.LogCaptureFixture) -> None:
    clock, logger = VirtualClock(), logging.getLogger("tests.log_rate")
    limit = LogRateLimit(clock, records=2, interval_s=60.0)
    logger.addFilter(limit)
    for k in range(5):
        logger.warning("accept failed %d", k)
    clock.sleep(59.0)
    logger.warning("accept failed 5")
    clock.sleep(1.0)
    logger.warning("another %s", "failure")
    logger.warning("one more")
    logger.removeFilter(limit)
    assert caplog.messages == [
        "accept failed 0",
        "accept failed 1",
        "another failure (and 4 suppressed messages before it)",
        "one more",
    ]
