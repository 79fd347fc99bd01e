"""Backups by the technician over HTTP: passphrase, backup to a USB drive beside the running exam, state and errors."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from services.backup.backup_folder import find_folder
from services.backup.backup_key import key_of_passphrase, read_header
from services.backup.backup_runner import BackupRunner
from services.backup.restore_backup import restore_backup
from services.delivery.usb_drives import UsbDrives
from services.http.app import create_app
from services.http.routes.backup import backup_routes
from services.records.capture_store import CaptureStore
from tests.journey.conftest import Rig, drive_id, technician_requests, until
from tests.journey.faults import post_capture

PASSPHRASE = "four plain words here"
DAY_S = 86_400.0
Ask = Callable[..., Any]


@pytest.fixture
def rig(build: Callable[..., Rig], tmp_path: Path, drives: UsbDrives) -> Iterator[Rig]:
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        runner = BackupRunner(rig.store.folder, lambda: rig.arbiter.is_idle, rig.clock)
        undo.callback(runner.close)
        routers = (backup_routes(runner, rig.store, drives, rig.clock),)
        rig.application = create_app(rig.arbiter, rig.authenticator, technician_routers=routers)
        yield rig


@pytest.fixture
def ask(rig: Rig) -> Ask:
    return technician_requests(rig, "/api/technician/backup")


def ended(ask: Ask) -> dict[str, Any]:
    """Wait for the end of a backup and return the state."""
    until(lambda: ask("GET").json()["total"] is None)
    state: dict[str, Any] = ask("GET").json()
    return state


def test_a_backup_beside_the_exam_restores_its_captures(ask: Ask, rig: Rig, stick: Path, tmp_path: Path) -> None:
    assert post_capture(rig).way == "verdict"
    until(lambda: bool(rig.store.captures()))
    first = rig.store.captures()[0].id
    assert ask("GET").json() == {
        "has_key": False,
        "last": None,
        "is_due": False,
        "done": None,
        "total": None,
        "error": None,
    }
    assert ask("POST", "/passphrase", json={"passphrase": PASSPHRASE}).json()["has_key"]
    assert ask("POST", json={"folder": drive_id(stick)}).status_code == 200
    done = ended(ask)
    assert (done["error"], done["last"]["number"], done["last"]["units"]) == (None, 1, 1)
    folder = find_folder(stick)
    secret = key_of_passphrase(read_header(folder), PASSPHRASE)
    restore_backup(folder, secret, tmp_path / "new", lambda done, total: None)
    with CaptureStore(tmp_path / "new", reserve_bytes=0) as store:
        assert [capture.id for capture in store.captures()] == [first]
        for name in store.get(first).files:
            assert store.read(first, name) == rig.store.read(first, name)


def test_a_backup_is_due_a_week_after_the_first_picture_that_is_in_none(ask: Ask, rig: Rig, stick: Path) -> None:
    post_capture(rig)
    rig.clock.elapsed_s += 7 * DAY_S + 60
    assert ask("GET").json()["is_due"]
    health = {check["name"]: check for check in rig.request("GET", "/api/health").json()["checks"]}
    assert (health["backup"]["ok"], health["backup"]["value"]) == (False, "none yet")
    ask("POST", "/passphrase", json={"passphrase": PASSPHRASE})
    ask("POST", json={"folder": drive_id(stick)})
    assert not ended(ask)["is_due"]
    rig.clock.elapsed_s += 30 * DAY_S
    assert not ask("GET").json()["is_due"], "nothing new is on the device"


def test_what_prevents_a_backup_is_in_the_state(ask: Ask, rig: Rig, stick: Path, tmp_path: Path) -> None:
    post_capture(rig)
    ask("POST", json={"folder": drive_id(stick)})
    assert ended(ask)["error"]["code"] == "backup.key"
    refused = ask("POST", "/passphrase", json={"passphrase": "short"})
    assert (refused.status_code, refused.json()["code"]) == (403, "backup.key")
    refused = ask("POST", json={"folder": str(tmp_path)})
    assert (refused.status_code, refused.json()["code"]) == (503, "stick.gone")
    ask("POST", "/passphrase", json={"passphrase": PASSPHRASE})
    ask("POST", json={"folder": drive_id(stick)})
    assert ended(ask)["error"] is None
    objects = find_folder(stick) / "objects"
    shutil.rmtree(objects)
    objects.write_text("a file where a folder was")
    ask("POST", json={"folder": drive_id(stick)})
    assert ended(ask)["error"]["code"] == "stick.gone"
