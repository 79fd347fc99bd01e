"""OpenAPI document: every answer is declared, and the server conforms to it (generated requests, Schemathesis)."""

import ast
import importlib
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any, get_args

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from pydantic import BaseModel
from schemathesis import GenerationMode
from schemathesis.core.failures import FailureGroup
from schemathesis.specs.openapi.checks import positive_data_acceptance

from services.delivery.uploader import HttpsUploader, UploadSettings
from services.delivery.usb_drives import UsbDrives
from services.http import schemas
from services.http.app import create_app
from services.http.authentication import OWN_SCREEN
from services.http.schemas.events import ServerSentEvent
from services.identity.users import ROLES
from tests.golden import http_transcript
from tests.project_files import nodes, python_files, text

STREAMS = "/api/(events|preview)$"  # streams: tests/journey/test_api.py reads them
PIN = "274913"
EXAMPLES = 6  # per operation and mode: about 500 requests


@pytest.fixture(scope="module")
def schema(build: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """OpenAPI schema of a real instrument with one visit, and its users: one with every role."""
    with ExitStack() as undo:
        rig = build(tmp_path_factory.mktemp("openapi"), undo)
        rig.request("POST", "/api/visits", json={"key": "0" * 16})
        uploader = HttpsUploader(
            UploadSettings(address="http://127.0.0.1:9/unknown", token=tmp_path_factory.getbasetemp() / "none")
        )
        app = create_app(
            rig.arbiter,
            rig.authenticator,
            host_names=("testserver",),
            usb_drives=UsbDrives(roots=()),
            uploader=uploader,
        )
        rig.authenticator.users.add("Asha", PIN, ROLES)
        token = rig.authenticator.sign_in("Asha", PIN, OWN_SCREEN)
        made = schemathesis.openapi.from_asgi("/api/openapi.json", app.http, headers={"Cookie": f"login={token}"})
        yield made.exclude(path_regex=STREAMS), rig.authenticator


@pytest.mark.parametrize("mode", GenerationMode)
def test_every_endpoint_conforms_to_the_openapi_document(schema: Any, mode: GenerationMode) -> None:
    """Send valid and invalid requests of the schema: no 5xx, no answer of another shape.

    A valid request may still be refused, since no schema says that a slot needs the right eye.
    """
    tried, broken, admitted, login = 0, [], set[int](), {"Cookie": ""}
    operations, authenticator = schema
    for found in operations.get_all_operations():
        operation = found.ok()
        token = authenticator.sign_in("Asha", PIN, OWN_SCREEN)  # the operation before may have ended the login
        login["Cookie"] = f"login={token}"

        @given(case=operation.as_strategy(generation_mode=mode))
        @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
        def conforms(case: Any) -> None:
            nonlocal tried
            tried += 1
            admitted.add(case.call_and_validate(headers=login, excluded_checks=[positive_data_acceptance]).status_code)

        try:
            conforms()
        except Unsatisfiable:
            continue  # an endpoint without parameters has no invalid requests
        except FailureGroup as group:
            broken.append(f"{operation.label}: {group.exceptions}")
    assert tried > 100
    assert 404 in admitted or 200 in admitted
    assert not broken, "\n\n".join(broken)


FILES = {  # operations whose answer is no JSON, with its media types
    "GET /api/captures/{id}/{name}": {"image/png", "image/jpeg", "image/tiff", "application/json"},
    "GET /api/preview": {"image/jpeg"},
    "GET /api/calibration/preview": {"image/jpeg"},
    "GET /api/events": {"text/event-stream"},
    "GET /api/visits/{id}/export.zip": {"application/zip", "application/octet-stream"},
    "GET /api/visits/{id}/montage/{eye}/picture.png": {"image/png"},
    "GET /api/technician/event-log.txt": {"text/plain"},
    "GET /api/technician/captures/{id}/again.png": {"image/png"},
    "GET /api/technician/accuracy.svg": {"image/svg+xml"},
}


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    """OpenAPI document of an instrument with every router."""
    complete: dict[str, Any] = http_transcript.openapi()
    return complete


def answers(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield operation and content of every successful answer that has a body."""
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for status, answer in operation["responses"].items():
                if status.startswith("2") and status != "204":
                    yield f"{method.upper()} {path}", answer.get("content", {})


def models() -> list[type[BaseModel]]:
    """Return every model of services/http/schemas."""
    found = []
    for module in pkgutil.iter_modules(schemas.__path__):
        members = vars(importlib.import_module(f"{schemas.__name__}.{module.name}")).values()
        found += [member for member in members if isinstance(member, type) and issubclass(member, BaseModel)]
    return found


def parts(annotation: Any) -> Iterator[Any]:
    """Yield a type and the types in it."""
    yield annotation
    for part in get_args(annotation):
        yield from parts(part)


def test_every_json_answer_has_a_model(document: dict[str, Any]) -> None:
    components = document["components"]["schemas"]
    unmodelled = []
    for operation, content in answers(document):
        if operation in FILES:
            continue
        assert set(content) == {"application/json"}, operation
        name = content["application/json"]["schema"].get("$ref", "").rpartition("/")[2]
        if not components.get(name, {}).get("properties"):
            unmodelled.append(operation)
    assert unmodelled == []


def test_pictures_files_and_streams_declare_their_media_type(document: dict[str, Any]) -> None:
    declared = {operation: set(content) for operation, content in answers(document)}
    assert {operation: declared[operation] for operation in FILES} == FILES


def test_every_problem_response_is_declared_as_json(document: dict[str, Any]) -> None:
    for path, operations in document["paths"].items():
        for operation in operations.values():
            for status in ("4XX", "5XX"):
                ((media_type, content),) = operation["responses"][status]["content"].items()
                assert (media_type, content["schema"]["$ref"].rpartition("/")[2]) == (
                    "application/json",
                    "ProblemResponse",
                ), path


def test_no_field_of_a_body_has_the_type_any() -> None:
    untyped = [
        f"{model.__name__}.{name}"
        for model in models()
        for name, field in model.model_fields.items()
        if any(part in (Any, object, dict, list) for part in parts(field.annotation))
    ]
    assert untyped == []


def test_every_published_event_has_a_payload_model() -> None:
    declared = {get_args(event.model_fields["event"].annotation)[0] for event in get_args(get_args(ServerSentEvent)[0])}
    published = {
        node.args[0].value
        for name in python_files("services")
        for node in nodes(text(name))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr.endswith("publish")
        if node.args and isinstance(node.args[0], ast.Constant)
    }
    assert published | {"beat"} == declared
