"""Time of a tablet: accepted once, where nothing better is there, forward but for an administrator, and recorded."""

import os
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services.errors import ClockBackwards, ClockRefused
from services.health.clock_request import REQUEST, needs_time, request_time, take_request
from services.health.clock_source import BROWSER_SOURCE, clock_state

CLOCK = VirtualClock(elapsed_s=60 * 86_400.0)
NOW = datetime(2026, 11, 25, 9, 30, tzinfo=timezone(timedelta(hours=5, minutes=30)))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Root of a device without network and clock cell."""
    (tmp_path / "run/diffuscope-clock").mkdir(parents=True)
    return tmp_path


def test_a_device_without_a_clock_takes_the_time_of_a_tablet_once(root: Path) -> None:
    taken: list[datetime] = []
    assert needs_time(root)
    request_time(NOW, CLOCK, root=root)
    assert "set by a tablet" in take_request(taken.append, CLOCK, root)
    assert taken == [NOW]
    assert clock_state(root) == "browser"
    assert not needs_time(root)
    with pytest.raises(ClockRefused):  # a second tablet may be wrong
        request_time(NOW + timedelta(hours=1), CLOCK, root=root)
    assert not (root / REQUEST).exists()


def test_only_an_administrator_sets_the_clock_backwards_or_once_more(root: Path) -> None:
    before = CLOCK.wall() - timedelta(hours=1)
    with pytest.raises(ClockBackwards):
        request_time(before, CLOCK, root=root)
    taken: list[datetime] = []
    for now in (before, NOW, before):
        request_time(now, CLOCK, by_administrator=True, root=root)
        assert "set by a tablet" in take_request(taken.append, CLOCK, root)
    assert taken == [before, NOW, before]
    (root / REQUEST).write_text(before.isoformat())  # written past the page
    assert "not needed" in take_request(lambda _: pytest.fail("the clock was set"), CLOCK, root)


def test_the_network_is_better_than_a_tablet(root: Path) -> None:
    """Also if it answers between the offer and the setting."""
    request_time(NOW, CLOCK, root=root)
    (root / "run/systemd/timesync").mkdir(parents=True)
    (root / "run/systemd/timesync/synchronized").touch()
    taken: list[datetime] = []
    assert "not needed" in take_request(taken.append, CLOCK, root)
    assert not taken
    assert clock_state(root) == "network"
    for by_administrator in (False, True):
        with pytest.raises(ClockRefused):
            request_time(NOW, CLOCK, by_administrator, root)


@pytest.mark.parametrize("year", [1970, 2025, 2060, 9999])
def test_an_impossible_date_is_not_offered(root: Path, year: int) -> None:
    with pytest.raises(ClockRefused):
        request_time(datetime(year, 1, 1, tzinfo=UTC), CLOCK, by_administrator=True, root=root)


def test_a_computer_without_the_unit_is_left_alone(tmp_path: Path) -> None:
    assert not needs_time(tmp_path)
    with pytest.raises(ClockRefused):
        request_time(NOW, CLOCK, root=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["", "yesterday", "2026-11-25T09:30:00"])
def test_an_invalid_request_is_removed_and_sets_nothing(root: Path, content: str) -> None:
    (root / REQUEST).write_text(content)
    with pytest.raises((ValueError, TypeError)):
        take_request(lambda _: pytest.fail("the clock was set"), VirtualClock(), root)
    assert not (root / REQUEST).exists()


@pytest.mark.parametrize("kind", ["link", "long", "pipe"])
def test_the_unit_of_root_follows_no_link_and_reads_no_long_request(root: Path, kind: str) -> None:
    """The instrument may write the folder of the request."""
    secret = root / "secret"
    secret.write_text(NOW.isoformat())
    match kind:
        case "link":
            (root / REQUEST).symlink_to(secret)
        case "long":
            (root / REQUEST).write_text(" " * 1_000 + NOW.isoformat())
        case "pipe":
            os.mkfifo(root / REQUEST)
    with pytest.raises(OSError, match=r"symbolic|longer|plain"):
        take_request(lambda _: pytest.fail("the clock was set"), CLOCK, root)
    assert not list((root / REQUEST).parent.iterdir())


def test_the_unit_of_root_writes_its_source_over_no_other_file(root: Path) -> None:
    victim = root / "victim"
    (root / BROWSER_SOURCE).symlink_to(victim)
    request_time(NOW, CLOCK, root=root)
    take_request(lambda _: None, CLOCK, root)
    assert not victim.exists()
    assert (root / BROWSER_SOURCE).stat(follow_symlinks=False).st_mode & 0o777 == 0o644
