"""The HTTP interface answers as recorded: every operation of the OpenAPI document, good and refused."""

import pytest

from tests.golden import compare, http_transcript

ALWAYS = {  # operations that take nothing and are open to all: only a foreign host name is refused
    "GET /api/status", "GET /api/health", "GET /api/protocol", "GET /api/exports", "GET /api/outbox",
    "GET /api/technician",
}  # fmt: skip


def test_the_openapi_document_is_as_recorded() -> None:
    difference = compare.difference(compare.read("openapi"), http_transcript.openapi())
    assert not difference, difference


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
