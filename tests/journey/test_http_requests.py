"""Requests as proxies and monitors send them: HEAD of every GET route, chunked bodies, an IPv6 address."""

import secrets
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from services.http.server import base_url

STREAMS = ("/api/events",)
LIT = ("/api/preview",)
CHANGING = frozenset({"date", "content-length", "set-cookie"})  # of answers that hold times
CHANGE_BY_SITE = [("cross-site", 403), ("same-site", 403), ("same-origin", 201), ("none", 201)]
PRESS = b'{"eye":"OS"}'


async def pieces(*contents: bytes) -> AsyncIterator[bytes]:
    for content in contents:
        yield content


def test_head_is_answered_as_get_without_a_body(rig: Any) -> None:
    capture = rig.request("POST", "/api/captures", json={"eye": "OD"}).json()["id"]
    document = rig.request("GET", "/api/openapi.json").json()["paths"]
    paths = [path.replace("{id}", capture) for path, methods in document.items() if "get" in methods]
    paths = [path for path in paths if path not in (*STREAMS, *LIT) and "{" not in path]
    paths += ["/", "/technician", "/nothing", "/api/openapi.json"]
    assert len(paths) > 15
    for path in paths:
        got, head = rig.request("GET", path), rig.request("HEAD", path)
        assert (head.status_code, head.content) == (got.status_code, b""), path
        assert {*head.headers} == {*got.headers}, path
        same = {name for name in got.headers if name not in CHANGING}
        assert {name: head.headers[name] for name in same} == {name: got.headers[name] for name in same}, path
        assert head.headers.get("content-length") != "0" or not got.content, path


def test_head_of_a_stream_ends_with_its_headers(rig: Any) -> None:
    head = rig.request("HEAD", "/api/events")
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"].startswith("text/event-stream")


def test_head_of_the_live_picture_gives_no_light(rig: Any) -> None:
    before = rig.exam.head.light.dose_report()
    assert rig.request("HEAD", "/api/preview").status_code == 204
    assert rig.exam.head.light.dose_report() == before
    assert rig.request("HEAD", "/api/preview", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403


def test_a_chunked_body_below_the_limit_is_read(rig: Any) -> None:
    async def post(client: httpx.AsyncClient, *contents: bytes, **headers: str) -> httpx.Response:
        own = {"Content-Type": "application/json", **headers}
        return await client.post("/api/captures", content=pieces(*contents), headers=own)

    taken = rig.ask(lambda client: post(client, PRESS[:5], PRESS[5:]))
    assert taken.request.headers["transfer-encoding"] == "chunked"
    assert (taken.status_code, taken.json()["eye"]) == (201, "OS")
    large = rig.ask(lambda client: post(client, PRESS, *[b" " * 1000] * 10))
    assert (large.status_code, large.json()["message"]) == (422, "this request is too large")
    both = rig.ask(lambda client: post(client, PRESS, **{"Content-Length": "12", "Transfer-Encoding": "chunked"}))
    assert both.status_code == 422
    packed = rig.ask(lambda client: post(client, PRESS, **{"Transfer-Encoding": "gzip, chunked"}))
    assert packed.status_code == 422


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("::1", "http://[::1]:8000"),
        ("::", "http://[::]:8000"),
        ("fe80::1%eth0", "http://[fe80::1%eth0]:8000"),
        ("127.0.0.1", "http://127.0.0.1:8000"),
        ("diffuscope.local", "http://diffuscope.local:8000"),
    ],
)
def test_the_printed_address_opens(host: str, url: str) -> None:
    assert base_url(host, 8000) == url


@pytest.mark.parametrize(("site", "status"), CHANGE_BY_SITE)
def test_a_change_that_another_site_asks_for_is_refused_without_an_origin(rig: Any, site: str, status: int) -> None:
    headers = {"Sec-Fetch-Site": site}
    answer = rig.request("POST", "/api/visits", headers=headers, json={"key": secrets.token_hex(8)})
    assert answer.status_code == status
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
