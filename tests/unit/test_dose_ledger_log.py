"""Second copy of the dose ledger: no damage of table or file lowers a dose that was counted."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy.orm import Session

from device.clock import VirtualClock
from device.errors import LightLimit, StoreError
from device.light_safety.dose_ledger import INTERVAL_S, DoseLedgerState
from device.values import EYES, Eye
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_log import LOG, MAX_BYTES, DoseLedgerLog
from services.records.dose_ledger_tables import DoseLedgerStore, add_given_dose
from services.records.snapshots import Snapshots, carry_dose

DAY_S, STOP = 86_400.0, 10.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CaptureStore]:
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as opened:
        yield opened


def ledger_of(store: CaptureStore, clock: VirtualClock) -> DoseLedgerStore:
    return DoseLedgerStore(store.engine, clock, DAY_S, boot="boot")


def run(folder: Path, *statements: str) -> None:
    with closing(sqlite3.connect(folder / "store.sqlite", isolation_level=None)) as tables:
        for statement in statements:
            tables.execute(statement)


def lose_rows(folder: Path) -> None:
    run(folder, "DELETE FROM doses", "DELETE FROM observed_time")


def lose_file(folder: Path) -> None:
    (folder / LOG).unlink(missing_ok=True)


def tear_last_line(folder: Path) -> None:
    content = (folder / LOG).read_bytes() if (folder / LOG).exists() else b""
    (folder / LOG).write_bytes(content[: -len(content) // 7])


def zero_file(folder: Path) -> None:
    (folder / LOG).write_bytes(bytes(1000))


def nothing(_: Path) -> None:
    pass


@dataclass(frozen=True)
class Exposure:
    """Light on one eye: reserved dose (J/cm2) and the share of it that was given."""

    eye: Eye
    reserved_j_per_cm2: float
    share: float


@dataclass(frozen=True)
class Damage:
    """Damage of one copy; with `reopen` the program starts again after it."""

    do: Callable[[Path], None]
    reopen: bool


ACTIONS = st.lists(
    st.one_of(
        st.builds(Exposure, st.sampled_from(EYES), st.floats(0, 0.01), st.floats(0, 1)),
        st.builds(Damage, st.sampled_from((lose_rows, lose_file, tear_last_line, zero_file)), st.booleans()),
    ),
    max_size=12,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(ACTIONS)
def test_no_damage_of_one_copy_lowers_a_dose(actions: list[Exposure | Damage]) -> None:
    """Damage of one copy at a time; after each, the ledger is used or opened again, which restores the other copy."""
    with TemporaryDirectory() as place, CaptureStore(Path(place) / "store", reserve_bytes=0) as store:
        clock = VirtualClock()
        ledger, given_j_per_cm2 = ledger_of(store, clock), dict.fromkeys(EYES, 0.0)
        for action in actions:
            if isinstance(action, Exposure):
                dose_j_per_cm2 = action.reserved_j_per_cm2 * action.share
                ledger.settle(ledger.reserve((action.eye,), action.reserved_j_per_cm2, STOP), dose_j_per_cm2)
                given_j_per_cm2[action.eye] += dose_j_per_cm2
            else:
                action.do(store.folder)
                if action.reopen:
                    ledger = ledger_of(store, clock)
                ledger.settle(ledger.reserve(("OD",), 0.0, STOP), 0.0)
            for eye, dose_j_per_cm2 in given_j_per_cm2.items():
                assert ledger.spent_j_per_cm2(eye) >= dose_j_per_cm2 - 1e-12  # rounding of the sums


def test_rows_that_are_deleted_while_the_instrument_runs_lower_no_dose(store: CaptureStore) -> None:
    ledger = ledger_of(store, VirtualClock())
    ledger.settle(ledger.reserve(("OD",), 1.0, STOP), 0.75)
    lose_rows(store.folder)
    assert ledger.spent_j_per_cm2("OD") == 0.75
    with pytest.raises(LightLimit):
        ledger.reserve(("OD",), 0.5, 1.0)


def test_a_settled_dose_replaces_its_reservation_in_both_copies(store: CaptureStore) -> None:
    ledger = ledger_of(store, VirtualClock())
    ledger.settle(ledger.reserve(("OS",), 1.0, STOP), 0.25)
    for damage in (lose_rows, lose_file):
        damage(store.folder)
        assert ledger_of(store, VirtualClock()).spent_j_per_cm2("OS") == 0.25


def test_the_observed_time_survives_the_loss_of_the_file(store: CaptureStore) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    ledger.reserve(("OD",), 1.0, STOP)
    clock.sleep(DAY_S / 2)
    ledger.reserve(("OS",), 1.0, STOP)
    lose_file(store.folder)
    again = ledger_of(store, clock)
    clock.sleep(DAY_S / 2 + 2 * INTERVAL_S)
    assert (again.spent_j_per_cm2("OD"), again.spent_j_per_cm2("OS")) == (0.0, 1.0)


def test_a_change_that_the_database_refuses_counts_the_higher_dose(store: CaptureStore) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    reserved = ledger.reserve(("OD",), 1.0, STOP)
    clock.sleep(1)
    run(store.folder, "CREATE TRIGGER full BEFORE UPDATE ON observed_time BEGIN SELECT RAISE(FAIL, 'no space'); END")
    with pytest.raises(StoreError):
        ledger.settle(reserved, 0.25)
    run(store.folder, "DROP TRIGGER full")
    assert ledger_of(store, VirtualClock()).spent_j_per_cm2("OD") == 1.0


@pytest.mark.parametrize("used", [True, False])
def test_both_eyes_of_a_used_device_count_as_full_if_table_and_file_are_gone(store: CaptureStore, used: bool) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    ledger.settle(ledger.reserve(("OD",), 0.5, STOP), 0.5)
    if used:
        store.save(Capture("a", "OD", clock.wall(), True, "00ff", CaptureReport(), {}), {"raw.tiff": b"raw"})
    lose_rows(store.folder)
    lose_file(store.folder)
    again = ledger_of(store, clock)
    for eye in EYES:
        if used:
            with pytest.raises(LightLimit):
                again.reserve((eye,), 0.001, STOP)
        else:
            again.reserve((eye,), 0.001, STOP)
    clock.sleep(DAY_S + 2000)
    again.reserve(("OS",), 0.001, STOP)


def test_a_restored_snapshot_lowers_no_dose(store: CaptureStore) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    snapshots = Snapshots(store.folder / "store.sqlite", clock)
    snapshots.create("s0001")
    ledger.settle(ledger.reserve(("OD",), 9.5, STOP), 9.5)
    store.close()
    snapshots.restore(snapshots.names()[0])
    with CaptureStore(store.folder, reserve_bytes=0) as restored, pytest.raises(LightLimit):
        ledger_of(restored, clock).reserve(("OD",), 1.0, STOP)


@pytest.mark.parametrize("change", ["observed_s = 1e9", "now_s = -1e9", "observed_s = 1e9, boot = 'other'"])
def test_a_later_time_in_the_tables_expires_no_dose(store: CaptureStore, change: str) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    ledger.settle(ledger.reserve(("OD",), 1.0, STOP), 0.75)
    clock.sleep(60)
    run(store.folder, f"UPDATE observed_time SET {change}")
    assert ledger.spent_j_per_cm2("OD") == 0.75
    assert ledger_of(store, clock).spent_j_per_cm2("OD") == 0.75
    clock.sleep(DAY_S + 2 * INTERVAL_S)
    assert ledger.spent_j_per_cm2("OD") == 0.0, "it expires by the time of the file"


def test_a_later_time_in_the_file_expires_no_dose(store: CaptureStore) -> None:
    ledger = ledger_of(store, VirtualClock())
    ledger.settle(ledger.reserve(("OD",), 1.0, STOP), 0.75)
    DoseLedgerLog(store.folder).append(DoseLedgerState({}, 1e9, "boot", 0.0))
    assert ledger.spent_j_per_cm2("OD") == 0.75


@pytest.mark.parametrize("change", ["dose_j_per_cm2 = 0", "interval = -1000", "eye = 'OS'"])
def test_a_changed_row_lowers_no_dose(store: CaptureStore, change: str) -> None:
    ledger = ledger_of(store, VirtualClock())
    ledger.settle(ledger.reserve(("OD",), 1.0, STOP), 0.75)
    run(store.folder, f"UPDATE doses SET {change}")
    assert ledger.spent_j_per_cm2("OD") == 0.75
    with pytest.raises(LightLimit):
        ledger_of(store, VirtualClock()).reserve(("OD",), 0.5, 1.0)


def test_the_dose_of_a_corrected_eye_is_in_both_copies(store: CaptureStore) -> None:
    clock = VirtualClock()
    ledger = ledger_of(store, clock)
    clock.sleep(2 * DAY_S)
    ledger.reserve(("OD",), 0.0, STOP)
    run(store.folder, "UPDATE observed_time SET observed_s = 0")
    with Session(store.engine) as session, session.begin():
        add_given_dose(session, "OS", 0.5)
    assert ledger.spent_j_per_cm2("OS") == 0.5
    lose_rows(store.folder)
    assert ledger.spent_j_per_cm2("OS") == 0.5


def test_a_database_of_a_device_with_more_time_blocks_no_light_for_longer_than_a_day(tmp_path: Path) -> None:
    for name, observed_s in (("old", 300 * DAY_S), ("new", 0.0)):
        clock = VirtualClock()
        with CaptureStore(tmp_path / name, reserve_bytes=0) as used:
            ledger = ledger_of(used, clock)
            clock.sleep(observed_s)
            ledger.reserve(("OD",), 1.0, STOP)
    carry_dose(tmp_path / "new" / "store.sqlite", tmp_path / "old" / "store.sqlite")
    shutil.copy(tmp_path / "old" / "store.sqlite", tmp_path / "new" / "store.sqlite")
    with CaptureStore(tmp_path / "new", reserve_bytes=0) as restored:
        clock = VirtualClock()
        ledger = ledger_of(restored, clock)
        assert ledger.spent_j_per_cm2("OD") == 1.0
        clock.sleep(DAY_S + 2 * INTERVAL_S)
        assert ledger.spent_j_per_cm2("OD") == 0.0


def test_the_file_does_not_grow_without_limit(tmp_path: Path) -> None:
    log = DoseLedgerLog(tmp_path)
    state = DoseLedgerState({("OD", interval): 0.1 for interval in range(150)}, 7.0, "b", 5.0)
    for number in range(200):
        state.now_s = float(number)
        log.append(state)
        assert (tmp_path / LOG).stat().st_size <= MAX_BYTES
    assert log.newest() == state


@pytest.mark.parametrize("damage", [nothing, tear_last_line])
def test_a_line_after_a_torn_line_is_read(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    log, state = DoseLedgerLog(tmp_path), DoseLedgerState({("OD", 1): 0.5}, 7.0, "b", 5.0)
    log.append(DoseLedgerState())
    damage(tmp_path)
    log.append(state)
    assert log.newest() == state
