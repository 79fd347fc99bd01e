"""Time of a tablet: taken once, where nothing better is there, and recorded."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from device.clock import VirtualClock
from services.health.clock_request import REQUEST, offer_time, take_request
from services.health.clock_source import clock_state

NOW = datetime(2026, 11, 25, 9, 30, tzinfo=timezone(timedelta(hours=5, minutes=30)))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Root of a device without network and clock cell."""
    (tmp_path / "run/diffuscope-clock").mkdir(parents=True)
    return tmp_path


def test_a_device_without_a_clock_takes_the_time_of_a_tablet_once(root: Path) -> None:
    taken: list[datetime] = []
    assert offer_time(NOW, root)
    assert "set by a tablet" in take_request(taken.append, VirtualClock(), root)
    assert taken == [NOW]
    assert clock_state(root) == "browser"
    assert not offer_time(NOW + timedelta(hours=1), root), "a second tablet may be wrong"
    assert not (root / REQUEST).exists()


def test_the_network_is_better_than_a_tablet(root: Path) -> None:
    """Also if it answers between the offer and the setting."""
    assert offer_time(NOW, root)
    (root / "run/systemd/timesync").mkdir(parents=True)
    (root / "run/systemd/timesync/synchronized").touch()
    taken: list[datetime] = []
    assert "not needed" in take_request(taken.append, VirtualClock(), root)
    assert not taken
    assert clock_state(root) == "network"
    assert not offer_time(NOW, root)


@pytest.mark.parametrize("year", [1970, 2025, 2060, 9999])
def test_an_impossible_date_is_not_offered(root: Path, year: int) -> None:
    assert not offer_time(datetime(year, 1, 1, tzinfo=UTC), root)


def test_a_computer_without_the_unit_is_left_alone(tmp_path: Path) -> None:
    assert not offer_time(NOW, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["", "yesterday", "2026-11-25T09:30:00"])
def test_an_invalid_request_is_removed_and_sets_nothing(root: Path, content: str) -> None:
    (root / REQUEST).write_text(content)
    with pytest.raises((ValueError, TypeError)):
        take_request(lambda _: pytest.fail("the clock was set"), VirtualClock(), root)
    assert not (root / REQUEST).exists()
