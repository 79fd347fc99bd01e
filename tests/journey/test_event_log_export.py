"""Export of the event log by the technician: download and copy to a USB drive."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from services.delivery.usb_drives import UsbDrives
from services.health.event_log import EventLog
from services.http.app import create_app
from services.http.routes.event_log import event_log_routes
from tests.journey.conftest import Rig, drive_id, technician_requests

log = logging.getLogger("services.instrument.test")


@pytest.fixture
def rig(build: Callable[..., Rig], tmp_path: Path, drives: UsbDrives) -> Iterator[Rig]:
    with ExitStack() as undo:
        rig = build(tmp_path, undo, wait=False)
        event_log = EventLog(tmp_path / "event-log")
        undo.callback(event_log.close)
        routers = (event_log_routes(event_log, drives, rig.clock),)
        rig.application = create_app(rig.arbiter, rig.authenticator, technician_routers=routers)
        yield rig


@pytest.fixture
def ask(rig: Rig) -> Callable[..., Any]:
    return technician_requests(rig, "/api/technician/event-log")


def test_event_log_is_downloaded_as_text(ask: Callable[..., Any]) -> None:
    log.warning("press failed: %s", "the camera is gone", extra={"code": "camera.missing"})
    answer = ask("GET", ".txt")
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert 'filename="event-log-' in answer.headers["content-disposition"]
    assert "WARNING: press failed: the camera is gone (camera.missing)" in answer.text


def test_second_copy_to_a_usb_drive_keeps_the_first(ask: Callable[..., Any], stick: Path) -> None:
    log.info("a picture was kept")
    first, second = (ask("POST", "/export", json={"folder": drive_id(stick)}).json()["folder"] for _ in range(2))
    assert second == f"{first}-2"
    assert "a picture was kept" in (stick / first / "event-log.txt").read_text()
    lines = (stick / second / "event-log.jsonl").read_text().splitlines()
    assert "a picture was kept" in [json.loads(line)["text"] for line in lines]


def test_export_needs_a_present_usb_drive(ask: Callable[..., Any], tmp_path: Path) -> None:
    refused = ask("POST", "/export", json={"folder": str(tmp_path)})
    assert (refused.status_code, refused.json()["code"]) == (503, "stick.gone")
