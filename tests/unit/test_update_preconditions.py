"""Preconditions of an update for valid, empty and malformed answers of the instrument, and for other forms."""

from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import pytest

from services.errors import (
    UpdateCapturesAtRisk,
    UpdateDuringExam,
    UpdateError,
    UpdateFailed,
    UpdatePowerLow,
    UpdateWrongDevice,
)
from services.update.preconditions import refuse_old_bootloader, refuse_while_in_use
from tests.updates import Board

NOW = datetime(2026, 11, 20, 12, tzinfo=UTC)
NO_JSON = [b"", b"not JSON", b'{"visits": [', b"\xff\xfe\xfd"]
NO_OBJECT = [b"5", b"null", b"true", b"[1, 2]", b"[[]]", b"[{}]", b'"busy"']
CHECK = b'{"name": "captures", "ok": false}'


def failed_checks(**bodies: bytes | None) -> tuple[str, ...]:
    """Return the failing checks of an instrument with these bodies of status and health; None: error 500."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = bodies.get(self.path.removeprefix("/api/").partition("?")[0], b"{}")
            self.send_response(500 if body is None else 200)
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, format: str, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        try:
            return refuse_while_in_use(f"http://127.0.0.1:{server.server_port}", 0.5, NOW)
        finally:
            server.shutdown()


@pytest.mark.parametrize("body", [None, *NO_JSON])
def test_an_instrument_without_a_valid_status_counts_as_unreachable(body: bytes | None) -> None:
    """It takes no pictures, so nothing else is read: the battery does not count."""
    assert failed_checks(status=body, health=b'{"battery": 0.1}') == ()


@pytest.mark.parametrize("body", [None, *NO_JSON, b"[]", b"{}"])
def test_an_answer_that_is_missing_malformed_or_empty_has_no_entries(body: bytes | None) -> None:
    assert failed_checks(health=body) == ()


@pytest.mark.parametrize(("minutes", "refused"), [(0, True), (9, True), (-9, True), (10, False), (-10, False)])
def test_a_picture_of_the_last_ten_minutes_refuses_by_any_clock(minutes: int, refused: bool) -> None:
    taken_at = (NOW - timedelta(minutes=minutes)).isoformat()
    status = f'{{"state": "aim", "last_capture_at": "{taken_at}"}}'.encode()
    if not refused:
        assert failed_checks(status=status) == ()
        return
    with pytest.raises(UpdateDuringExam, match=f"taken {minutes} minutes ago"):
        failed_checks(status=status)


@pytest.mark.parametrize("status", [b"[]", b"{}", b'{"state": null}', b'{"state": "aim"}'])
def test_battery_and_checks_count_whether_or_not_the_status_names_a_state(status: bytes) -> None:
    with pytest.raises(UpdatePowerLow):
        failed_checks(status=status, health=b'{"battery": 0.49}')
    with pytest.raises(UpdateCapturesAtRisk, match="unreadable"):
        failed_checks(status=status, health=b'{"checks": [{"name": "captures", "ok": false, "value": "unreadable"}]}')
    checks = b'{"battery": null, "checks": [{"name": "heat", "ok": false, "value": "70"}]}'
    assert failed_checks(status=status, health=checks) == ("heat",)


@pytest.mark.parametrize(
    ("name", "body"),
    [
        *[(name, body) for name in ("status", "health") for body in NO_OBJECT],
        ("status", b'{"state": 5}'),
        ("status", b'{"last_capture_at": "yesterday"}'),
        ("status", b'{"last_capture_at": "2026-11-20T11:50:00"}'),
        ("health", b'{"battery": "half"}'),
        ("health", b'{"checks": {"name": "heat"}}'),
        ("health", b'{"checks": [%s]}' % CHECK),
        ("health", b'{"checks": [{"ok": true, "value": ""}]}'),
        ("health", b'{"checks": [{"name": "heat", "ok": "perhaps", "value": ""}]}'),
    ],
)
def test_an_answer_of_another_form_refuses_the_update_with_a_remedy(name: str, body: bytes) -> None:
    with pytest.raises(UpdateFailed, match=rf"to /api/{name}\S* has another form than expected") as refused:
        failed_checks(**{name: body})
    assert isinstance(refused.value, UpdateError)
    assert refused.value.remedy == UpdateFailed.default_remedy


@pytest.mark.parametrize(("built", "accepted"), [("2024-09-23", False), ("2024-10-31", False), ("2024-11-05", True)])
def test_an_update_needs_a_bootloader_of_november_2024(tmp_path: Path, built: str, accepted: bool) -> None:
    file = tmp_path / "build-timestamp"
    file.write_bytes(int(datetime.fromisoformat(f"{built}T12:00Z").timestamp()).to_bytes(4, "big"))
    if accepted:
        refuse_old_bootloader(file)
        return
    with pytest.raises(UpdateWrongDevice, match=f"is of {built}") as refused:
        refuse_old_bootloader(file)
    assert "Bootloader (Pi 5 family)" in refused.value.remedy


def test_an_old_bootloader_refuses_an_update_before_anything_is_written(tmp_path: Path) -> None:
    """Defect 12: a tried version hung in the firmware, and no one looked at its date."""
    board, file = Board.new(tmp_path), tmp_path / "build-timestamp"
    file.write_bytes(int(datetime(2024, 9, 23, tzinfo=UTC).timestamp()).to_bytes(4, "big"))
    board.bundle("two.raucb")
    with pytest.raises(UpdateWrongDevice, match="bootloader"):
        board.updater("1.0", bootloader=file).install(None)
    assert not board.is_off
    assert board.boot() == "A"
    board.updater("1.0", bootloader=tmp_path / "absent").install(None)
    assert board.boot() == "B"


def test_a_computer_without_a_bootloader_in_its_device_tree_may_be_updated(tmp_path: Path) -> None:
    refuse_old_bootloader(tmp_path / "build-timestamp")
