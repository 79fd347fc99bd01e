"""What the OpenAPI document promises, tried with requests that nobody thought of (Schemathesis)."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.core.failures import FailureGroup
from schemathesis.specs.openapi.checks import positive_data_acceptance

from services.instrument.api import create_app
from services.instrument.carrier import Https, SendSettings
from services.instrument.exporting import Sticks

STREAMS = "/api/(events|preview)$"  # they wait for news: tests/journey/test_api.py reads them
EXAMPLES = 6  # of every address, in each mode: about 500 requests


@pytest.fixture(scope="module")
def book(build: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The document of a real instrument with somebody in it."""
    with ExitStack() as undo:
        rig = build(tmp_path_factory.mktemp("openapi"), undo)
        rig.request("POST", "/api/visits", json={"key": "0" * 16})
        way = Https(SendSettings(address="http://127.0.0.1:9/nobody", token=tmp_path_factory.getbasetemp() / "none"))
        app = create_app(rig.owner, rig.door, names=("testserver",), sticks=Sticks(roots=()), carrier=way)
        yield schemathesis.openapi.from_asgi("/api/openapi.json", app).exclude(path_regex=STREAMS)


@pytest.mark.parametrize("mode", GenerationMode)
def test_every_address_keeps_what_the_document_promises(book: Any, mode: GenerationMode) -> None:
    """Requests as the document wants them, and requests that break it: no 5xx, no answer of another shape.

    What fits the document may still be refused: that a slot is of the right eye is not said by any schema.
    """
    tried, broken = 0, []
    for found in book.get_all_operations():
        operation = found.ok()

        @given(case=operation.as_strategy(generation_mode=mode))
        @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
        def keeps_its_promises(case: Any) -> None:
            nonlocal tried
            tried += 1
            case.call_and_validate(excluded_checks=[positive_data_acceptance])

        try:
            keeps_its_promises()
        except Unsatisfiable:
            continue  # an address that takes nothing cannot be asked wrongly
        except FailureGroup as group:
            broken.append(f"{operation.label}: {group.exceptions}")
    assert tried > 100
    assert not broken, "\n\n".join(broken)
