"""The stand-in of the page's tests answers as the real server does: the same requests, statuses and shapes."""

import asyncio
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from services.instrument.carrier import Https, SendSettings
from services.instrument.exporting import Sticks
from tests.browser.stub import Stub, build
from tests.browser.stub_visits import unsent
from tests.journey.conftest import MakeRig, Rig

FREE = {"report", "numbers", "files"}  # measured values: their keys depend on the picture
PRESS = {"eye": "OD", "visit": "{visit}", "slot": "R-centre"}
OTHER_SCREEN = {"X-Controller": "f" * 16}
Step = tuple[str, str, dict[str, Any] | None]
# What a page asks, in the order of a visit; `{visit}`, `{capture}` and `{stick}` are named by the answers before.
STORY: dict[str, Step] = {
    "a missing visit": ("GET", "/api/visits/nobody", None),
    "a missing capture": ("GET", "/api/captures/nobody", None),
    "protocol": ("GET", "/api/protocol", None),
    "begin": ("POST", "/api/visits", {}),
    "press before consent": ("POST", "/api/captures", PRESS),
    "aim before consent": ("GET", "/api/preview?after=0&eye=OD&visit={visit}", None),
    "decline": ("PATCH", "/api/visits/{visit}", {"field": "consent", "value": "declined"}),
    "press against consent": ("POST", "/api/captures", PRESS),
    "agree": ("PATCH", "/api/visits/{visit}", {"field": "consent", "value": "agreed"}),
    "aim": ("GET", "/api/preview?after=0&eye=OD&visit={visit}", None),
    "press": ("POST", "/api/captures", PRESS),
    "a request that no page sends": ("POST", "/api/visits/{visit}/slots", {"slot": "R-centre"}),
    "one capture": ("GET", "/api/captures/{capture}", None),
    "captures": ("GET", "/api/captures", None),
    "keep": ("POST", "/api/captures/{capture}/keep", {}),
    "empty a slot": ("POST", "/api/visits/{visit}/slots", {"slot": "R-centre", "capture": None}),
    "choose": ("POST", "/api/visits/{visit}/slots", {"slot": "R-centre", "capture": "{capture}"}),
    "could not": ("POST", "/api/visits/{visit}/could-not", {"slot": "R-nerve", "reason": "pupil"}),
    "the other eye": ("POST", "/api/captures/{capture}/eye", {"eye": "OS"}),
    "finish": ("POST", "/api/visits/{visit}/finish", {}),
    "one visit": ("GET", "/api/visits/{visit}", None),
    "outbox": ("GET", "/api/outbox", None),
    "try": ("POST", "/api/outbox/try", {}),
    "reopen": ("POST", "/api/visits/{visit}/reopen", {}),
    "visits": ("GET", "/api/visits?limit=20", None),
    "sticks": ("GET", "/api/exports", None),
    "copy": ("POST", "/api/visits/{visit}/export", {"folder": "{stick}"}),
    "a test picture": ("POST", "/api/captures", {"eye": "OD"}),
    "controls": ("POST", "/api/controller", {}),
    "press on another screen": ("POST", "/api/captures", {"eye": "OD"}),
    "status": ("GET", "/api/status", None),
}
Answers = dict[str, httpx.Response]


def filled(value: Any, known: dict[str, str]) -> Any:
    """The same request with the names that earlier answers gave."""
    if isinstance(value, dict):
        return {key: filled(one, known) for key, one in value.items()}
    if isinstance(value, str):
        for place, name in known.items():
            value = value.replace(place, name)
    return value


async def told(app: FastAPI, stub: Stub | None) -> Answers:
    """The answers of one server to the whole story."""
    known, answers = {"{visit}": "", "{capture}": "", "{stick}": ""}, {}
    transport, own = httpx.ASGITransport(app=app), {"Sec-Fetch-Site": "same-origin"}
    async with httpx.AsyncClient(transport=transport, base_url="http://eye.local", timeout=30, headers=own) as client:
        for name, (method, path, body) in STORY.items():
            order = None if body is None else {"key": secrets.token_hex(8), **filled(body, known)}
            headers = OTHER_SCREEN if "another screen" in name else {}
            answer = await client.request(method, filled(path, known), json=order, headers=headers)
            answers[name] = answer
            if name == "begin":
                known["{visit}"] = answer.json()["id"]
            if name == "press":
                known["{capture}"] = answer.json()["id"]
            if name == "sticks":
                known["{stick}"] = answer.json()["folders"][0]["id"]
            if name == "finish" and stub is not None:
                stub.unsent.append(unsent(stub.visits.kept[known["{visit}"]]))
    return answers


def differences(real: Any, stub: Any, at: str) -> Iterator[str]:
    """Places where two answers have other keys or other kinds of values; null fits everything."""
    if real is None or stub is None or at.rsplit(".", 1)[-1] in FREE:
        return
    if isinstance(real, dict) and isinstance(stub, dict):
        if real.keys() != stub.keys():
            yield f"{at}: only the real server has {real.keys() - stub.keys()}, the stub {stub.keys() - real.keys()}"
        for key in real.keys() & stub.keys():
            yield from differences(real[key], stub[key], f"{at}.{key}")
    elif isinstance(real, list) and isinstance(stub, list):
        for one, other in zip(real[:1], stub[:1], strict=False):
            yield from differences(one, other, f"{at}[0]")
    elif kind(real) is not kind(stub):
        yield f"{at}: {real!r} of the real server, {stub!r} of the stub"


def kind(value: Any) -> type:
    return float if isinstance(value, int) and not isinstance(value, bool) else type(value)


def body_of(answer: httpx.Response) -> Any:
    return answer.json() if answer.headers["content-type"] == "application/json" else None


@pytest.fixture
def instrument(make_rig: MakeRig, tmp_path: Path) -> Rig:
    """A real instrument with a stick and a receiver that does not answer."""
    stick, mounts = tmp_path / "media" / "STICK", tmp_path / "mounts"
    stick.mkdir(parents=True)
    mounts.write_text(f"/dev/sda1 {stick} vfat rw 0 0\n")
    way = Https(SendSettings(address="http://127.0.0.1:9/nobody", token=tmp_path / "none"))
    return make_rig(sticks=Sticks((tmp_path / "media",), mounts), carrier=way)


def test_the_stand_in_answers_as_the_real_server_does(instrument: Rig) -> None:
    stub = Stub(sending=True, expose_s=0.01, refine_s=0.02)
    real, other = asyncio.run(told(instrument.app, None)), asyncio.run(told(build(stub), stub))
    statuses = {name: (real[name].status_code, other[name].status_code) for name in STORY}
    assert {name: both for name, both in statuses.items() if both[0] != both[1]} == {}
    assert real["copy"].status_code == 200
    broken = [line for name in STORY for line in differences(body_of(real[name]), body_of(other[name]), name)]
    assert broken == []
    refused = {name: (real[name].json()["code"], other[name].json()["code"]) for name in STORY
               if real[name].status_code >= 400 and real[name].status_code != 422}  # fmt: skip
    assert {name: both for name, both in refused.items() if both[0] != both[1]} == {}
    news = {"x-frame", "x-age-ms", "x-aim"}
    assert news <= real["aim"].headers.keys()
    assert news <= other["aim"].headers.keys()


def test_the_stand_in_tells_the_same_events(instrument: Rig) -> None:
    stub = Stub(expose_s=0.01, refine_s=0.02)
    asyncio.run(told(instrument.app, None))
    asyncio.run(told(build(stub), None))
    said = [{kind: data.keys() for kind, data in events} for events in (instrument.told(), stub.events)]
    for name in ("state", "stage", "verdict"):
        assert said[0][name] == said[1][name], name
