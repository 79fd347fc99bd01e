"""Storage of a capture in a background thread: live pictures and presses continue during a slow write."""

from collections.abc import Callable
from pathlib import Path
from threading import Event, current_thread
from typing import Any

import pytest

from device.errors import StoreFull
from services.instrument.background import run_in_thread
from tests.journey.asking import live_picture


class SlowDisk:
    """Stub of the disk; its query for free bytes calls `delay` once before a capture is written."""

    def __init__(self) -> None:
        self.delay: Callable[[], None] | None = None

    def free_bytes(self, _: Path) -> int:
        if current_thread().name == "head":  # asks for room before each light; the write is in another thread
            return 10**9
        delay, self.delay = self.delay, None
        if delay is not None:
            delay()
        return 10**9


def test_run_in_thread_returns_result_or_error_and_polls_keep_alive() -> None:
    polled = Event()
    assert run_in_thread(lambda: polled.wait(30), polled.set) is True

    def fail() -> None:
        raise StoreFull("no room")

    with pytest.raises(StoreFull):
        run_in_thread(fail, polled.set)


def test_progress_and_live_pictures_continue_during_a_slow_write(make_rig: Any) -> None:
    disk, seen = SlowDisk(), []
    rig = make_rig(store={"free_bytes": disk.free_bytes})

    def two_live_pictures() -> None:
        for _ in range(2):
            before = rig.exam.snapshot.output.preview.number
            rig.clock.sleep(1.0)
            seen.append(live_picture(rig.exam, before, wait_s=20))

    disk.delay = two_live_pictures
    kept = rig.exam.press("OD").result(60)
    assert [live.number for live in seen] == sorted({live.number for live in seen}), "taken during the slow write"
    stages = [data for kind, data in rig.published_events() if kind == "stage"]
    fractions = [data["fraction"] for data in stages]
    keeping = [data["fraction"] for data in stages if data["stage"] == "keep"]
    assert len(keeping) >= 3, "the stage itself, and one event per live picture"
    assert keeping[0] == 0.9 < keeping[1] <= 1.0
    assert fractions == sorted(fractions)
    assert rig.store.captures() == [kept]


def test_a_press_during_a_slow_write_is_exposed_at_once(make_rig: Any, wait_until: Callable[..., None]) -> None:
    disk, pressed = SlowDisk(), []
    rig = make_rig(store={"free_bytes": disk.free_bytes})

    def quick_looks() -> int:
        return sum(kind == "stage" and data["stage"] == "quick" for kind, data in rig.published_events())

    def press_again() -> None:
        pressed.append(rig.exam.press("OS"))
        wait_until(lambda: quick_looks() == 2)

    disk.delay = press_again
    first = rig.exam.press("OD").result(60)
    second = pressed[0].result(60)
    assert rig.store.captures() == [second, first]
