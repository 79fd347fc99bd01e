"""Erasure of a patient over HTTP: counts, receipt, audit log, refusals beside camera and backup."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from services.backup.backup_key import key_for_recipients, write_key
from services.backup.backup_runner import BackupRunner
from services.http.app import create_app
from services.http.routes.erasure import erasure_routes
from services.identity.users import ROLES
from services.records.audit_log import AuditLog
from services.records.erasure import ErasureReceipt, verified
from tests.journey.conftest import Rig, until
from tests.unit.test_backup import RECIPIENT

PIN, NUMBER = "274913", "ZQ-77120"
Ask = Callable[..., Any]


@pytest.fixture
def idle() -> Event:
    """Set while a backup may go on."""
    idle = Event()
    idle.set()
    return idle


@pytest.fixture
def rig(build: Callable[..., Rig], tmp_path: Path) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield build(tmp_path, undo)


@pytest.fixture
def served(rig: Rig, idle: Event) -> Iterator[tuple[Ask, BackupRunner, AuditLog]]:
    runner = BackupRunner(rig.store.folder, idle.is_set, rig.clock)
    log = AuditLog(rig.store.folder, b"k" * 32, rig.clock)
    routers = (erasure_routes(rig.arbiter, runner),)
    rig.application = create_app(rig.arbiter, rig.authenticator, technician_routers=routers, audit_log=log)
    rig.authenticator.users.add("Asha", PIN, ROLES)
    login = rig.request("POST", "/api/login", json={"name": "Asha", "secret": PIN})
    cookie = {"Cookie": login.headers["Set-Cookie"].partition(";")[0]}
    yield lambda method, path, **more: rig.request(method, path, headers=cookie, **more), runner, log
    idle.set()
    runner.close()


def begun(ask: Ask) -> str:
    """Begin a visit of the patient with NUMBER."""
    answer = ask("POST", "/api/visits", json={"key": "1" * 16, "number": NUMBER})
    assert answer.status_code == 201
    return str(answer.json()["id"])


def test_a_patient_is_counted_and_erased_with_a_receipt(served: tuple[Ask, BackupRunner, AuditLog], rig: Rig) -> None:
    ask, _, log = served
    visit = begun(ask)
    assert ask("GET", "/api/patients", params={"number": NUMBER.lower()}).json() == {
        "visits": 1,
        "captures": 0,
        "files": 0,
    }
    order = {"number": NUMBER, "reason": "withdrawn"}
    until(lambda: rig.arbiter.is_idle)
    answer = ask("POST", "/api/patients/erase", json=order)
    assert answer.status_code == 200
    assert verified(answer.content, None) == ErasureReceipt.model_validate(answer.json())
    assert NUMBER not in answer.text
    assert ask("GET", f"/api/visits/{visit}").status_code == 404
    assert ask("GET", "/api/visits", params={"q": NUMBER}).json()["visits"] == []
    for again in (
        ask("POST", "/api/patients/erase", json=order),
        ask("GET", "/api/patients", params={"number": NUMBER}),
    ):
        assert (again.status_code, again.json()["code"]) == (404, "store.unknown")
    assert ask("POST", "/api/patients/erase", json={"number": "", "reason": "mistake"}).status_code == 422
    assert ask("POST", "/api/patients/erase", json={**order, "reason": "none"}).status_code == 422
    entry = next(entry for entry in reversed(log.entries(20)) if entry.action == "erase-patient")
    assert (len(entry.record), entry.more["field"]) == (16, "withdrawn")


def test_a_patient_is_not_erased_beside_a_picture_or_a_backup(
    served: tuple[Ask, BackupRunner, AuditLog], rig: Rig, idle: Event, tmp_path: Path
) -> None:
    ask, runner, _ = served
    begun(ask)
    order = {"number": NUMBER, "reason": "requested"}
    until(lambda: rig.arbiter.is_idle)
    write_key(rig.store.folder, key_for_recipients([RECIPIENT]))
    idle.clear()
    runner.begin(tmp_path)
    refused = ask("POST", "/api/patients/erase", json=order)
    assert (refused.status_code, refused.json()["message"]) == (409, "a backup is under way")
    idle.set()
    until(lambda: runner.state().progress is None)
    ask("GET", "/api/preview", params={"after": 0})
    refused = ask("POST", "/api/patients/erase", json=order)
    assert (refused.status_code, refused.json()["message"]) == (409, "the camera is in use")
    assert ask("GET", "/api/patients", params={"number": NUMBER}).status_code == 200
