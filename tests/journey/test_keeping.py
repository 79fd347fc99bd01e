"""While a picture is kept, which may take a slow disk a while, neither who aims nor who presses waits for it."""

from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from device.errors import StoreFull
from services.instrument.aside import aside


class SlowDisk:
    """A disk that is asked for its room before a capture is written, and once takes its time to say so."""

    def __init__(self) -> None:
        self.slowly: Callable[[], None] | None = None

    def free_bytes(self, _: Path) -> int:
        slowly, self.slowly = self.slowly, None
        if slowly is not None:
            slowly()
        return 10**9


def test_what_is_done_aside_gives_its_result_or_its_error_and_others_go_on_meanwhile() -> None:
    others_went_on = Event()
    assert aside(lambda: others_went_on.wait(30), others_went_on.set) is True

    def refused() -> None:
        raise StoreFull("no room")

    with pytest.raises(StoreFull):
        aside(refused, others_went_on.set)


def test_while_the_disk_writes_the_bar_moves_and_who_aims_sees_live_pictures(make_rig: Any) -> None:
    disk, seen = SlowDisk(), []
    rig = make_rig(store={"free_bytes": disk.free_bytes})

    def two_live_pictures() -> None:
        for _ in range(2):
            before = rig.exam._preview.number
            rig.clock.sleep(1.0)
            seen.append(rig.exam.preview(before, wait_s=20))

    disk.slowly = two_live_pictures
    kept = rig.exam.press("OD").result(60)
    assert [live.number for live in seen] == sorted({live.number for live in seen}), "made while the disk was busy"
    stages = [data for kind, data in rig.told() if kind == "stage"]
    fractions = [data["fraction"] for data in stages]
    keeping = [data["fraction"] for data in stages if data["stage"] == "keep"]
    assert len(keeping) >= 3, "the stage itself, and as often as a live picture was made"
    assert keeping[0] == 0.9 < keeping[1] <= 1.0
    assert fractions == sorted(fractions)
    assert rig.store.captures() == [kept]


def test_who_presses_while_the_disk_writes_is_exposed_at_once(make_rig: Any, wait_until: Callable[..., None]) -> None:
    disk, pressed = SlowDisk(), []
    rig = make_rig(store={"free_bytes": disk.free_bytes})

    def quick_looks() -> int:
        return sum(kind == "stage" and data["stage"] == "quick" for kind, data in rig.told())

    def press_on() -> None:
        pressed.append(rig.exam.press("OS"))
        wait_until(lambda: quick_looks() == 2)

    disk.slowly = press_on
    first = rig.exam.press("OD").result(60)
    second = pressed[0].result(60)
    assert rig.store.captures() == [second, first]
