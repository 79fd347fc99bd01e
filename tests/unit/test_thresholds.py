"""Thresholds below, at and above the limit, for every part that uses the rule: head, checks, alerts, update, page."""

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from device import atomic_io
from device.calibration import calibration_validity
from device.config.operating_limits import is_battery_low, is_too_hot
from services.errors import UpdatePowerLow
from services.health import alerts, thresholds
from services.health.alerts import CoolingTimer
from services.health.checks import Check, PressTimes, run_checks
from services.update.preconditions import refuse_while_in_use
from services.update.settings import UpdateSettings
from tests.appliance.instrument import served
from tests.unit.test_checks import HEALTHY

WEB = Path(__file__).parents[2] / "web"
SECOND = timedelta(seconds=1)
DAY = datetime(2026, 11, 20, tzinfo=UTC)


def check(name: str, **facts: object) -> Check:
    return next(result for result in run_checks(replace(HEALTHY, **facts)) if result.name == name)


@pytest.mark.parametrize(("head_c", "hot"), [(54.99, False), (55.0, False), (55.01, True)])
def test_a_head_at_its_temperature_limit_is_not_too_hot(head_c: float, hot: bool) -> None:
    assert is_too_hot(head_c, 55.0) is hot
    assert check("heat", head_c=head_c, warmest_c=55.0).ok is not hot
    (active,) = alerts.heat_alerts(head_c, 55.0, CoolingTimer(), 0.0)
    assert active.code == ("heat.hot" if hot else "heat.warm")


@pytest.mark.parametrize(("computer_c", "hot"), [(79.9, False), (80.0, False), (80.1, True)])
def test_a_computer_at_its_temperature_limit_is_not_too_hot(computer_c: float, hot: bool) -> None:
    assert check("heat", computer_c=computer_c).ok is not hot


@pytest.mark.parametrize(("head_c", "warm"), [(49.99, False), (50.0, False), (50.01, True), (56.0, True)])
def test_a_head_counts_as_warm_above_five_degrees_below_the_limit(head_c: float, warm: bool) -> None:
    assert thresholds.is_warm(head_c, 55.0) is warm
    assert bool(list(alerts.heat_alerts(head_c, 55.0, CoolingTimer(), 0.0))) is warm


@pytest.mark.parametrize(("charge", "low"), [(0.049, True), (0.05, False), (0.051, False)])
def test_the_least_battery_charge_is_not_low(charge: float, low: bool) -> None:
    assert is_battery_low(charge, 0.05) is low
    assert check("battery", battery=charge, emptiest=0.05).ok is not low
    (active,) = alerts.battery_alerts(charge, 0.05)
    assert active.code == ("batt.empty" if low else "batt.low")


def test_the_battery_check_names_the_least_charge_that_is_accepted() -> None:
    assert check("battery", battery=0.05, emptiest=0.05).limit == "at least 5%"


@pytest.mark.parametrize(("charge", "low"), [(0.499, True), (0.5, False), (0.501, False)])
def test_an_update_is_installed_at_the_least_battery_charge(charge: float, low: bool) -> None:
    least = UpdateSettings().lowest_battery
    assert least == 0.5
    with served() as page:
        page.battery = charge
        if low:
            with pytest.raises(UpdatePowerLow):
                refuse_while_in_use(page.at, least, DAY)
        else:
            assert refuse_while_in_use(page.at, least, DAY) == ()


@pytest.mark.parametrize("least", [0.0, 0.05, 0.1, 0.3])
@pytest.mark.parametrize("visits", [0, 1, 9, 10, 11, 42])
def test_a_charge_for_whole_visits_counts_as_that_number(least: float, visits: int) -> None:
    """Binary fractions do not turn ten visits into nine."""
    charge = least + visits / thresholds.VISITS_PER_CHARGE
    assert thresholds.visits_per_battery(charge, least) == visits
    assert thresholds.visits_per_battery(charge - 1e-3, least) == visits - 1


@pytest.mark.parametrize(("visits", "few"), [(9, True), (10, False), (11, False)])
def test_space_for_ten_visits_is_enough(visits: int, few: bool) -> None:
    assert thresholds.are_few_visits(visits) is few
    assert check("space", people_left=visits).ok is not few
    assert bool(list(alerts.space_alerts(visits, visits))) is few
    assert bool(list(alerts.battery_alerts(0.05 + visits / thresholds.VISITS_PER_CHARGE, 0.05))) is few


@pytest.mark.parametrize(("free", "fits"), [(1499, False), (1500, True), (1501, True)])
def test_a_file_that_fits_exactly_beside_the_reserve_has_room(free: int, fits: bool) -> None:
    assert atomic_io.has_room(1000, free, reserve_bytes=500) is fits


@pytest.mark.parametrize(("lateness_s", "late"), [(0.99, False), (1.0, False), (1.01, True)])
def test_a_capture_at_the_largest_lateness_is_not_late(lateness_s: float, late: bool) -> None:
    assert thresholds.is_late(lateness_s) is late
    assert check("speed", presses=[PressTimes(2.0 + lateness_s, 4.0, 2.0)] * 100).ok is not late
    assert bool(list(alerts.lateness_alerts(lateness_s))) is late


@pytest.mark.parametrize(("since", "wrong"), [(-SECOND, True), (timedelta(0), False), (SECOND, False)])
def test_the_date_of_the_newest_capture_is_not_wrong(since: timedelta, wrong: bool) -> None:
    for now, newest in ((DAY + since, DAY), (thresholds.EARLIEST_DATE + since, None)):
        assert thresholds.is_date_wrong(now, newest) is wrong
        assert check("clock", now=now, newest=newest).ok is not wrong
        assert bool(list(alerts.date_alerts(now, newest, 0.0, is_synchronised=False))) is wrong


@pytest.mark.parametrize(("drift_s", "jumped"), [(3599.0, False), (3600.0, False), (-3600.0, False), (-3601.0, True)])
def test_a_clock_that_differs_by_more_than_an_hour_has_jumped(drift_s: float, jumped: bool) -> None:
    assert thresholds.has_clock_jumped(drift_s) is jumped
    assert bool(list(alerts.date_alerts(DAY, None, drift_s, is_synchronised=False))) is jumped
    assert not list(alerts.date_alerts(DAY, None, drift_s, is_synchronised=True))


def test_a_calibration_is_old_and_expired_from_its_limits_on() -> None:
    for limit, rule in (
        (calibration_validity.REMIND_AFTER, calibration_validity.is_old),
        (calibration_validity.EXPIRES_AFTER, calibration_validity.is_expired),
    ):
        assert [rule(limit + by) for by in (-SECOND, timedelta(0), SECOND)] == [False, True, True]


def test_the_page_has_the_same_limits() -> None:
    """The page shows the free space with every status, and the cooling time of a refused capture."""
    modules = "\n".join(
        path.read_text(encoding="utf-8") for path in sorted(WEB.rglob("*.js")) if "vendor" not in path.parts
    )
    assert re.findall(r"SPACE_PLENTY = (\d+)", modules) == [str(thresholds.MAX_SHOWN_VISITS)]
    assert re.findall(r'"heat\.hot".*wait_s: (\d+)', modules) == [f"{thresholds.COOLING_S:.0f}"]
