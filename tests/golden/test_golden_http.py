"""Golden tests of the HTTP interface: every operation of the OpenAPI document, good and refused."""

from typing import Any

import pytest

from tests.golden import compare, http_transcript

ALWAYS = {  # public operations without input: the only refusal is that of a foreign host name
    "GET /api/status",
    "GET /api/health",
    "GET /api/programme",
    "GET /api/exports",
    "GET /api/upload-queue",
    "GET /api/login",
    "DELETE /api/login",
}


PROSE = {"description", "summary", "title", "operationId"}


def interface(document: dict[str, Any]) -> Any:
    """Return what an OpenAPI document promises: no prose, no operationIds, schemas in place of their names."""

    def bare(value: Any, is_mapping: bool = False) -> Any:
        if isinstance(value, list):
            return [bare(entry) for entry in value]
        if not isinstance(value, dict):
            return value
        if "$ref" in value:
            name = value["$ref"].removeprefix("#/components/schemas/")
            return bare(document["components"]["schemas"][name])
        return {
            key: bare(entry, is_mapping=key == "properties")
            for key, entry in value.items()
            if is_mapping or key not in PROSE
        }

    return bare({"info": document["info"] | {"title": None}, "paths": document["paths"]})


def test_the_openapi_document_promises_what_is_recorded() -> None:
    difference = compare.difference(interface(compare.read("openapi")), interface(http_transcript.openapi()))
    assert not difference, difference


def test_prose_and_names_of_schemas_are_no_promise_and_all_else_is() -> None:
    def document(name: str, prose: str, kind: str) -> dict[str, Any]:
        schema = {"title": name, "description": prose, "properties": {"title": {"type": kind, "title": name}}}
        answer = {"content": {"$ref": f"#/components/schemas/{name}"}, "summary": prose}
        return {"info": {"title": prose}, "paths": {"/a": answer}, "components": {"schemas": {name: schema}}}

    recorded = interface(document("Old", "a", "string"))
    assert interface(document("New", "b", "string")) == recorded
    assert interface(document("Old", "a", "integer")) != recorded


@pytest.mark.parametrize("name", http_transcript.CHAPTERS)
def test_a_transcript_is_as_recorded(name: str) -> None:
    difference = compare.difference(compare.read(f"http-{name}"), http_transcript.CHAPTERS[name]())
    assert not difference, difference


def test_the_transcripts_hold_a_good_and_a_refused_request_of_every_operation() -> None:
    good, refused, by_host = set(), set(), set()
    for name in http_transcript.CHAPTERS:
        for exchange in compare.read(f"http-{name}"):
            answer = exchange["response"]
            if answer["status"] < 400:
                good.add(exchange["operation"])
            elif answer["body"]["code"] == "link.host":
                by_host.add(exchange["operation"])
            else:
                refused.add(exchange["operation"])
    every = set(http_transcript.operations(compare.read("openapi")))
    assert every - good == set()
    assert every - refused == ALWAYS
    assert every - by_host == set()
