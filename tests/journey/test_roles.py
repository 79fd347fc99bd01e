"""Generated requests as each role, and without a login: none gets a server error (Schemathesis, random phase too).

`python -m pytest -s tests/journey/test_roles.py` prints the number of requests and of admitted ones of each role.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode

from services.delivery.uploader import HttpsUploader, UploadSettings
from services.delivery.usb_drives import UsbDrives
from services.http.app import create_app
from services.http.authentication import OWN_SCREEN, Authenticator
from services.identity.users import ROLES
from services.records.audit_log import AuditLog
from tests.journey.test_openapi import PIN, STREAMS

EXAMPLES = 6  # of each operation, mode and role: about 480 requests of each role
NO_LOGIN = "no login"


@pytest.fixture(scope="module")
def served(build: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Authenticator]]:
    """OpenAPI schema of an instrument without limits in rate, with a visit, a capture, and a user of each role."""
    with ExitStack() as undo:
        rig = build(tmp_path_factory.mktemp("roles"), undo)
        rig.request("POST", "/api/visits", json={"key": "0" * 16})
        assert rig.request("POST", "/api/captures", json={"eye": "OD"}).status_code == 201
        none = tmp_path_factory.getbasetemp() / "none"
        app = create_app(
            rig.arbiter,
            rig.authenticator,
            host_names=("testserver",),
            usb_drives=UsbDrives(roots=()),
            uploader=HttpsUploader(UploadSettings(address="http://127.0.0.1:9/unknown", token=none)),
            audit_log=AuditLog(tmp_path_factory.mktemp("audit"), b"k" * 32, rig.clock),
            rates={},
        )
        for role in ("administrator", *ROLES[:3]):
            rig.authenticator.users.add(role, PIN, [role])
        token = rig.authenticator.sign_in("screener", PIN, OWN_SCREEN)
        made = schemathesis.openapi.from_asgi("/api/openapi.json", app.http, headers={"Cookie": f"login={token}"})
        yield made.exclude(path_regex=STREAMS), rig.authenticator


@pytest.mark.timeout(600)  # about 480 requests beside other tests
@pytest.mark.parametrize("role", [*ROLES, NO_LOGIN])
def test_no_role_gets_a_server_error(served: tuple[Any, Authenticator], role: str) -> None:
    operations, authenticator = served
    answers, broken = Counter[int](), list[str]()
    for mode in GenerationMode:
        for found in operations.get_all_operations():
            operation = found.ok()

            @given(case=operation.as_strategy(generation_mode=mode))
            @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck), deadline=None)
            def has_no_server_error(case: Any) -> None:
                # A request may end the login or change the secret: each has a login of its own.
                login = "" if role == NO_LOGIN else authenticator.logins.begin(found_user(authenticator, role))
                status = case.call(headers={"Cookie": f"login={login}"}).status_code
                answers[status] += 1
                if status >= 500:
                    broken.append(f"{status} {case.method} {case.formatted_path} {case.query} {case.body!r:.200}")

            try:
                has_no_server_error()
            except Unsatisfiable:
                continue  # an operation without parameters has no invalid requests
    admitted = sum(number for status, number in answers.items() if status not in (401, 403))
    sys.stdout.write(f"{role}: {answers.total()} requests, {admitted} admitted, {len(broken)} server errors\n")
    assert broken == []
    assert answers.total() > 300
    assert admitted > 20


def found_user(authenticator: Authenticator, role: str) -> Any:
    user = authenticator.users.find(role)
    assert user is not None
    return user
