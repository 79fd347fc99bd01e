"""Periodic worker: steps, wake-ups, errors and the end of its thread."""

from collections.abc import Callable
from threading import Event

import pytest

from device.errors import StoreError
from services.periodic_worker import PeriodicWorker

PATIENCE_S = 20.0


class Steps:
    """Step of a worker that counts its calls and lets the test wait for one of them."""

    def __init__(self, results: list[Callable[[], bool]]) -> None:
        self.results, self.count, self.done = results, 0, Event()

    def __call__(self) -> bool:
        self.count += 1
        try:
            return self.results.pop(0)() if self.results else False
        finally:
            if not self.results:
                self.done.set()


def refuse() -> bool:
    raise StoreError("the disk refuses")


def test_a_wake_up_brings_a_step_before_its_time_and_a_successful_step_the_next() -> None:
    steps = Steps([lambda: True, lambda: True, lambda: False])
    worker = PeriodicWorker("steps", steps, 3600.0, "no step")
    worker.begin()
    worker.wake()
    assert steps.done.wait(PATIENCE_S)
    worker.close()
    assert steps.count == 3
    assert not worker.has_failed


def test_a_storage_error_is_logged_and_the_thread_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    steps = Steps([refuse, lambda: False])
    worker = PeriodicWorker("steps", steps, 0.001, "no step")
    worker.begin()
    assert steps.done.wait(PATIENCE_S)
    worker.close()
    assert "no step: the disk refuses" in caplog.text


def test_a_closed_worker_can_begin_again() -> None:
    steps = Steps([])
    worker = PeriodicWorker("steps", steps, 3600.0, "no step")
    for _ in range(2):
        worker.begin()
        worker.close()
    assert steps.count == 0
    worker.begin()
    worker.wake()
    assert steps.done.wait(PATIENCE_S)
    worker.close(timeout_s=PATIENCE_S)
