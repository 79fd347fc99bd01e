"""Status collector: the inputs of the health checks from instrument, capture store, upload queue and computer."""

import json
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from device.clock import Clock
from device.errors import StoreError
from device.light_safety.hazard import light_limits
from services.backup.backup_key import read_key
from services.errors import BackupDamaged, RecordErased, RecordRemoved
from services.health.checks import PressTimes, StatusSnapshot
from services.health.clock_source import clock_state
from services.health.instrument_status import InstrumentStatus
from services.records.audit_log import audit_log_bytes
from services.records.capture import Capture
from services.records.capture_store import CaptureStore
from services.records.visit_repository import VisitRepository

COMPUTER_TEMPERATURE_FILE = Path("/sys/class/thermal/thermal_zone0/temp")
SETTINGS_PROBLEM_FILE = Path("/run/diffuscope-settings/problem.json")  # of services/identity, at the last start
PLATFORM_DEVICES = Path("/sys/devices/platform")
MAX_PRESSES = 100


def collect_status(
    instrument: InstrumentStatus,
    lamp_is_dark: bool,
    store: CaptureStore,
    people: VisitRepository,
    clock: Clock,
    unsent: tuple[int, int] | None = None,
) -> StatusSnapshot:
    """Return the current inputs of the checks; `unsent` as in `StatusSnapshot`."""
    newest, orphans, damaged, error = _store_status(store, people)
    return StatusSnapshot(
        state=instrument.state,
        problem=instrument.problem,
        lamp_is_dark=lamp_is_dark,
        calibration=instrument.calibration_error,
        store=error,
        captures_left=store.space.captures_left(),
        people_left=store.space.visits_left(len(people.programme.slots)),
        battery=instrument.battery,
        emptiest=instrument.emptiest,
        head_c=instrument.head_c,
        warmest_c=instrument.warmest_c,
        computer_c=int(COMPUTER_TEMPERATURE_FILE.read_text()) / 1000 if COMPUTER_TEMPERATURE_FILE.exists() else None,
        now=clock.wall(),
        clock=clock_state(),
        newest=newest[0].taken_at if newest else None,
        presses=_press_times(newest),
        unsent=unsent,
        torn_bytes=list(store.quarantine.sizes_bytes().values()),
        orphans=orphans,
        damaged=damaged,
        recovery=store.recovery,
        backup_at=(backup := _backup_status(store))[0],
        unsaved_since=backup[1],
        unchecked_limits=light_limits().unchecked,
        takes_blue_light="blue" in people.programme.colours,
        settings_problem=read_settings_problem(SETTINGS_PROBLEM_FILE),
        throttled_bits=read_throttled_bits(PLATFORM_DEVICES),
        lacks_files=store.space.lacks_files(),
        audit_log_bytes=audit_log_bytes(store.folder),
    )


def _press_times(captures: Sequence[Capture]) -> list[PressTimes]:
    """Return the times of captures whose tap and read-out were in one run."""
    reports = [capture.report for capture in captures]
    return [
        PressTimes(report.from_read_out_s, report.from_tap_s, report.budget_s)
        for report in reports
        if report.from_read_out_s is not None and report.from_tap_s is not None
    ]


def read_throttled_bits(devices: Path) -> int | None:
    """Return the state of supply and clock from the firmware's file in sysfs; None on another computer."""
    for file in devices.glob("soc*/soc*firmware/get_throttled"):
        with suppress(OSError, ValueError):
            return int(file.read_text(encoding="ascii"), 16)
    return None


def read_settings_problem(file: Path) -> tuple[str, str] | None:
    """Return message and remedy of the settings that the last start did not take; None without a problem."""
    if not file.exists():
        return None
    content = json.loads(file.read_text(encoding="utf-8"))
    return str(content["message"]), str(content["remedy"])


def _backup_status(store: CaptureStore) -> tuple[datetime | None, datetime | None]:
    """Return the time of the last backup, and of the first capture that is in none; None without one.

    A key or database that cannot be read counts as no backup and no capture: the check `captures` reports the store.
    """
    try:
        key = read_key(store.folder)
        backup_at = None if key is None or key.last is None else key.last.made_at
    except BackupDamaged:
        backup_at = None
    try:
        return backup_at, store.first_taken_after(backup_at)
    except StoreError:
        return backup_at, None


def _store_status(store: CaptureStore, people: VisitRepository) -> tuple[list[Capture], int, int, StoreError | None]:
    """Return the last MAX_PRESSES captures, the number of orphans, the number of damaged rows, and the store's error.

    Orphan: complete capture folder without a row. Damaged rows: of captures and visits. The error is None if the store
    accepts a file and returns all files of the newest capture; otherwise the other values are empty and 0.
    """
    try:
        newest = store.captures(MAX_PRESSES)
        store.check_writable()
        for name in newest[0].files if newest else ():
            with suppress(RecordRemoved, RecordErased):
                store.read(newest[0].id, name)
        return newest, len(store.quarantine.orphans()), store.damaged() + people.damaged(), None
    except StoreError as error:
        return [], 0, 0, error
