"""Health checks: each passes once and fails once, with a remedy."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from device.errors import BusFault, CameraMissing, HeadMismatch, StoreFull
from services.health.checks import CHECKS, PressTimes, StatusSnapshot, picture_times, run_checks
from services.health.collector import read_throttled_bits
from services.health.probe import table
from services.records.recovery_report import RecoveryReport

SPEED = [check.__name__ for check in CHECKS].index("speed")
NOON = datetime(2026, 11, 21, 12, tzinfo=UTC)
HEALTHY = StatusSnapshot(
    state="aim",
    problem=None,
    lamp_is_dark=True,
    calibration=None,
    store=None,
    captures_left=400,
    people_left=100,
    battery=0.8,
    emptiest=0.05,
    head_c=31.0,
    warmest_c=55.0,
    computer_c=62.0,
    now=NOON,
    clock="not_set",
    newest=datetime(2026, 11, 20, tzinfo=UTC),
    presses=[PressTimes(1.5, 2.5, 5.0)] * 100,
    unsent=(4, 0),
    throttled_bits=0xE0000,
    unsaved_since=datetime(2026, 11, 14, 12, tzinfo=UTC),
)
FAULTS: list[tuple[str, dict[str, Any]]] = [
    ("camera", {"problem": CameraMissing("the camera is gone")}),
    ("camera", {"state": "starting"}),
    ("lamp", {"lamp_is_dark": False}),
    ("calibration", {"calibration": HeadMismatch("another head")}),
    ("captures", {"store": StoreFull("0 bytes are free")}),
    ("space", {"people_left": 9}),
    ("space", {"people_left": 9, "lacks_files": True}),
    ("battery", {"battery": 0.04}),
    ("battery", {"battery": BusFault("the fuel gauge does not answer")}),
    ("heat", {"head_c": 56.0}),
    ("heat", {"computer_c": 85.0}),
    ("heat", {"head_c": BusFault("the thermometer does not answer")}),
    ("clock", {"now": datetime(2020, 1, 1, tzinfo=UTC)}),
    ("clock", {"newest": datetime(2026, 11, 22, tzinfo=UTC)}),
    ("speed", {"presses": [PressTimes(1.0, 2.0, 5.0)] * 50 + [PressTimes(9.0, 10.0, 5.0)] * 50}),
    ("sending", {"unsent": (4, 1)}),
    ("speed", {"presses": [PressTimes(2.5, 3.5, 1.0)] * 100}),
    ("database", {"recovery": RecoveryReport(rebuilt_because="it is missing or empty")}),
    ("database", {"recovery": RecoveryReport(conflicts=["v"])}),
    ("database", {"recovery": RecoveryReport(missing=["c"])}),
    ("database", {"recovery": RecoveryReport(lost_visits=["v"])}),
    ("backup", {"unsaved_since": datetime(2026, 11, 14, 11, tzinfo=UTC)}),
    ("audit_log", {"audit_log_bytes": 50_600_000}),
    ("settings", {"settings_problem": ("diffuscope.toml is not TOML", "Correct the file on the card.")}),
    ("power", {"throttled_bits": 0x50005}),
    ("power", {"throttled_bits": 0x10000}),
    ("power", {"throttled_bits": 0x4}),
]


def test_an_instrument_that_is_well_passes_every_check() -> None:
    assert [check.ok for check in run_checks(HEALTHY)] == [True] * len(CHECKS)


@pytest.mark.parametrize(("name", "change"), FAULTS)
def test_each_check_fails_alone_with_a_remedy(name: str, change: dict[str, Any]) -> None:
    checks = run_checks(replace(HEALTHY, **change))
    failed = [check for check in checks if not check.ok]
    assert [check.name for check in failed] == [name]
    assert len(failed[0].remedy) > 20
    assert failed[0].remedy.endswith(".")
    assert failed[0].remedy in table(checks)


def test_one_slow_press_in_a_hundred_is_accepted() -> None:
    presses = [PressTimes(1.0, 2.0, 5.0)] * 99 + [PressTimes(30.0, 31.0, 5.0)]
    assert all(check.ok for check in run_checks(replace(HEALTHY, presses=presses)))


def test_of_two_presses_the_slower_one_counts() -> None:
    speed = run_checks(replace(HEALTHY, presses=[PressTimes(7.0, 8.0, 5.0), PressTimes(2.0, 3.0, 5.0)]))[SPEED]
    assert (speed.ok, speed.value) == (
        False,
        "of 2 pictures half within 2.00 s of the last frame and 3.00 s of the tap, "
        "99 of 100 within 7.00 s and 8.00 s; 1 missed their deadline",
    )


def test_a_picture_within_its_time_budget_is_not_late() -> None:
    assert run_checks(replace(HEALTHY, presses=[PressTimes(30.8, 31.6, 30.0)] * 100))[SPEED].ok


def test_a_deadline_is_missed_by_more_than_a_twentieth_of_the_budget() -> None:
    presses = [
        PressTimes(took_s, took_s + 1.0, budget_s) for took_s, budget_s in ((0.27, 0.26), (0.28, 0.26), (5.3, 5.0))
    ]
    times = picture_times(presses)
    assert times is not None
    assert (times.pictures, times.missed) == (3, 2)
    assert (times.from_read_out.p50_s, times.from_tap.p99_s) == (0.28, 6.3)


def test_a_large_number_of_visits_is_not_shown() -> None:
    shown = [
        check.value
        for n in (200, 201)
        for check in run_checks(replace(HEALTHY, people_left=n))
        if check.name == "space"
    ]
    assert shown == ["200 patients", "plenty, more than 200 patients"]


def test_few_free_files_have_their_own_remedy() -> None:
    """Gigabytes may be free: "make room" would not help who looks at bytes."""
    checks = [
        check for lacks in (False, True) for check in run_checks(replace(HEALTHY, people_left=9, lacks_files=lacks))
    ]
    by_bytes, by_files = (check for check in checks if check.name == "space")
    assert "files" in by_files.value
    assert "files" in by_files.remedy
    assert "files" not in by_bytes.value + by_bytes.remedy


def test_quarantined_captures_are_reported_with_the_free_space() -> None:
    space = next(check for check in run_checks(replace(HEALTHY, torn_bytes=[9_500_000, 1])) if check.name == "space")
    assert (space.ok, space.value) == (True, "100 patients; half-saved pictures aside: 2, 10 MB")


def test_missing_parts_of_a_head_are_no_failure() -> None:
    bare = replace(HEALTHY, battery=None, head_c=None, computer_c=None, newest=None, presses=[], unsent=None)
    checks = run_checks(bare)
    assert all(check.ok for check in checks)
    assert [check.name for check in checks if not check.known] == ["battery", "heat", "clock", "speed", "sending"]


def test_an_update_is_judged_by_checks_of_the_release_only() -> None:
    names = {check.name for check in run_checks(HEALTHY) if check.of_release}
    assert names == {"camera", "lamp", "calibration", "captures"}


@pytest.mark.parametrize(
    ("content", "bits"), [("50005", 0x50005), ("0\n", 0), ("", None), ("nonsense", None), (None, None)]
)
def test_the_state_of_the_supply_is_read_from_the_firmware(
    tmp_path: Path, content: str | None, bits: int | None
) -> None:
    """`soc@107c000000:firmware` is the name of a Raspberry Pi 5, `soc:firmware` that of earlier ones."""
    if content is not None:
        (tmp_path / "soc@107c000000/soc@107c000000:firmware").mkdir(parents=True)
        (tmp_path / "soc@107c000000/soc@107c000000:firmware/get_throttled").write_text(content)
    assert read_throttled_bits(tmp_path) == bits


def test_blue_light_is_named_with_its_hazard() -> None:
    """Only if the programme lists it."""
    plain, blue = (
        next(check for check in run_checks(replace(HEALTHY, takes_blue_light=on)) if check.name == "light_limits")
        for on in (False, True)
    )
    assert "blue" not in plain.value
    assert "45 times the hazard of green" in blue.value
