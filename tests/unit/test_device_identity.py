"""Identity of a device in its records: made once, never in a backup, in every number, report and export."""

import json
import re
import uuid
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy.orm import Session

from device.clock import VirtualClock
from services.backup.store_contents import rest_of_store
from services.delivery.visit_export import export_files, uploaded_files
from services.errors import StoreDamaged
from services.health.clock_source import clock_state
from services.records.capture_store import CaptureStore
from services.records.device_identity import DeviceIdentity, board_serial_number, load_or_create_device, read_device
from services.records.numbering import automatic_number
from services.records.patient_rows import identity, patient_of_number
from services.records.programme import load_programme
from services.records.schema import CounterRow
from services.records.visit_repository import VisitRepository

DRAWS = 10_000
NO_BOARD = Path("/nonexistent")


def test_the_identity_is_made_once_with_the_serial_number_of_the_board(tmp_path: Path) -> None:
    (tmp_path / "serial-number").write_text("10000000A1B2C3D4\0")
    made = load_or_create_device(tmp_path, tmp_path / "serial-number")
    assert made.serial == "10000000a1b2c3d4"
    assert uuid.UUID(made.uuid).version == 4
    assert load_or_create_device(tmp_path, NO_BOARD) == read_device(tmp_path) == made


def test_a_copied_card_gets_an_identity_of_its_own(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Two devices with copies of one card must not give the same numbers; the other device keeps its identity."""
    boards = [tmp_path / name for name in ("one", "two")]
    for number, board in enumerate(boards):
        board.write_text(f"10000000a1b2c3d{number}\0")
    first = load_or_create_device(tmp_path, boards[0])
    copy = load_or_create_device(tmp_path, boards[1])
    assert (copy.serial, copy.uuid != first.uuid) == ("10000000a1b2c3d1", True)
    assert copy.prefix != first.prefix
    assert first.uuid in caplog.text
    assert json.loads((tmp_path / "device.json").read_text())["before"] == first.uuid
    assert load_or_create_device(tmp_path, boards[1]) == copy
    assert load_or_create_device(tmp_path, NO_BOARD) == copy, "a disk that is read on a laptop stays what it is"


def test_a_computer_without_a_board_gets_a_random_serial_number(tmp_path: Path) -> None:
    assert board_serial_number(NO_BOARD) is None
    assert re.fullmatch("[0-9a-f]{16}", load_or_create_device(tmp_path, NO_BOARD).serial)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"uuid": "x", "serial": "y"}', '{"uuid": 5, "serial": "y"}'])
def test_a_damaged_identity_is_an_error_and_is_not_replaced(tmp_path: Path, content: str) -> None:
    (tmp_path / "device.json").write_text(content)
    with pytest.raises(StoreDamaged, match="identity"):
        load_or_create_device(tmp_path)
    assert (tmp_path / "device.json").read_text() == content


def test_no_backup_contains_the_identity(tmp_path: Path) -> None:
    """A restored backup belongs to the new device, whose numbers must not repeat those of the old one."""
    load_or_create_device(tmp_path, NO_BOARD)
    (tmp_path / "technician.json").touch()
    assert set(rest_of_store(tmp_path)) == {"technician.json"}


@given(st.uuids(version=4))
def test_the_prefix_of_a_device_has_letters_that_are_not_misread(id: uuid.UUID) -> None:
    prefix = DeviceIdentity(str(id), "").prefix
    assert re.fullmatch("[A-HJ-NP-Z]{5}", prefix)
    assert DeviceIdentity(str(id), "other board").prefix == prefix


def test_numbers_of_two_devices_are_disjoint(tmp_path: Path) -> None:
    """Defect 8: every device began with A00013. Of 10,000 automatic numbers of each, none is equal."""
    numbers = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        programme = load_programme().for_device(load_or_create_device(tmp_path / name, NO_BOARD).prefix)
        prefix = programme.numbers.prefix
        numbers.append({automatic_number(prefix, count) for count in range(1, DRAWS + 1)})
    assert [len(series) for series in numbers] == [DRAWS, DRAWS]
    assert not numbers[0] & numbers[1]


def test_a_programme_may_leave_the_letters_of_the_device_out() -> None:
    programme = load_programme()
    numbers = programme.numbers.model_copy(update={"device_in_number": False})
    changed = programme.model_copy(update={"numbers": numbers})
    assert changed.for_device("KFTRW").numbers.prefix == "A"
    assert programme.for_device("KFTRW").numbers.prefix == "AKFTRW"


def test_a_number_of_an_earlier_release_is_found_with_and_without_its_prefix(tmp_path: Path) -> None:
    with CaptureStore(tmp_path) as store, Session(store.engine) as session:
        known = patient_of_number(session, "A", None, "2026-03-02T12:00:00+00:00")
        assert identity(session, known) == ("A00013", {})
        assert session.get(CounterRow, "A") is not None
        for typed in ("A00013", "00013"):
            assert patient_of_number(session, "AKFTRW", typed, "2026-03-03T12:00:00+00:00") == known
        first = patient_of_number(session, "AKFTRW", None, "2026-03-03T12:00:00+00:00")
        assert identity(session, first) == ("AKFTRW00013", {})
        assert patient_of_number(session, "AKFTRW", "00013", "2026-03-03T12:00:00+00:00") == first
        for typed in ("A00014", "AKFTRW00014"):
            with pytest.raises(ValueError, match="mistyped"):
                patient_of_number(session, "AKFTRW", typed, "2026-03-03T12:00:00+00:00")


def test_an_export_without_a_picture_names_its_device(tmp_path: Path) -> None:
    device = load_or_create_device(tmp_path, NO_BOARD)
    with CaptureStore(tmp_path) as store:
        people = VisitRepository(store.engine, load_programme(), VirtualClock())
        visit = people.begin("0" * 16)
        for files in (export_files(store, people, visit), uploaded_files(store, people, visit)):
            block = json.loads(files["visit.json"])["device"]
            assert (block["uuid"], block["serial"]) == (device.uuid, device.serial)


@pytest.mark.parametrize(
    ("synchronized", "since_epoch", "expected"),
    [
        (True, None, "network"),
        (True, "0", "network"),
        (False, "1795000000", "rtc"),
        (False, "63", "not_set"),
        (False, "", "not_set"),
        (False, None, "not_set"),
    ],
)
def test_the_source_of_the_date_is_network_or_a_clock_that_kept_it(
    tmp_path: Path, synchronized: bool, since_epoch: str | None, expected: str
) -> None:
    """Defect 9: a board without a cell begins in 1970, and systemd then takes the time of the last shutdown."""
    for name, content in {
        "run/systemd/timesync/synchronized": "" if synchronized else None,
        "sys/class/rtc/rtc0/since_epoch": since_epoch,
    }.items():
        if content is not None:
            (tmp_path / name).parent.mkdir(parents=True)
            (tmp_path / name).write_text(content)
    assert clock_state(tmp_path) == expected
