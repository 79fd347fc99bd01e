"""Consent: no light for a visit without a recorded consent; a capture without a visit is a test picture."""

import asyncio
import json
import secrets
import time
from collections.abc import Awaitable
from typing import Any

import httpx
import pytest

from services.records.capture import CaptureReport
from tests.journey.asking import record_answer, visit_with_consent
from tests.journey.conftest import MakeRig, Rig, until
from tests.journey.faults import wait_until_idle

ENOUGH_S = 1.0  # real time; three seconds of aiming in virtual time take a tenth of it
ANSWERS = {"consent.missing": None, "consent.declined": "declined"}


def capture_request(visit: str) -> dict[str, str]:
    return {"key": secrets.token_hex(8), "eye": "OD", "visit": visit, "slot": "R-centre"}


def refused(answer: httpx.Response, code: str) -> None:
    assert (answer.status_code, answer.json()["code"]) == (409, code), answer.text
    assert len(answer.json()["remedy"]) > 20


@pytest.mark.parametrize("code", ANSWERS)
@pytest.mark.parametrize("before", [None, "agreed"])
def test_lamp_stays_off_for_a_visit_without_consent(old_rig: Rig, code: str, before: str | None) -> None:
    wait_until_idle(old_rig)
    visit = old_rig.request("POST", "/api/visits", json={"key": secrets.token_hex(8)}).json()["id"]
    for value in (before, ANSWERS[code]):
        if value is not None or before is not None:
            record_answer(old_rig, visit, "consent", value)
    frames, captures = old_rig.world.frames, len(old_rig.store.captures())
    refused(old_rig.request("POST", "/api/captures", json=capture_request(visit)), code)
    for eye in ("", "&eye=OD"):
        refused(old_rig.request("GET", f"/api/preview?after=0&visit={visit}{eye}"), code)
    time.sleep(ENOUGH_S / 10)
    assert (old_rig.world.frames, old_rig.world.illumination) == (frames, None)
    assert len(old_rig.store.captures()) == captures
    record_answer(old_rig, visit, "consent", "agreed")
    assert old_rig.request("POST", "/api/captures", json=capture_request(visit)).status_code == 201
    assert old_rig.request("GET", f"/api/preview?after=0&visit={visit}").status_code == 200


def test_preview_for_an_unknown_visit_is_404(old_rig: Rig) -> None:
    answer = old_rig.request("GET", "/api/preview?visit=unknown")
    assert (answer.status_code, answer.json()["code"]) == (404, "store.unknown")


def while_aiming(rig: Rig, visit: str, value: str | None, send: Any) -> tuple[httpx.Response, int]:
    """Withdraw the consent while a request waits; return its answer, and the frames exposed until the withdrawal."""
    order = {"key": secrets.token_hex(8), "field": "consent", "value": value}

    async def scenario(client: httpx.AsyncClient) -> tuple[httpx.Response, int]:
        assert (await client.get(f"/api/preview?after=0&visit={visit}&eye=OD")).status_code in (200, 204)
        rig.block_exposures()
        await asyncio.to_thread(rig.wait_for_blocked_exposure)
        request: Awaitable[httpx.Response] = asyncio.create_task(send(client))
        await asyncio.sleep(0.2)
        assert (await client.patch(f"/api/visits/{visit}", json=order)).status_code == 200
        frames = rig.world.frames
        rig.clock.gate.set()
        return await request, frames

    answer: tuple[httpx.Response, int] = rig.ask(scenario)
    return answer


@pytest.mark.parametrize("code", ANSWERS)
def test_withdrawing_consent_while_aiming_turns_the_lamp_off(make_rig: MakeRig, code: str) -> None:
    rig = make_rig()
    visit = visit_with_consent(rig)["id"]
    answer, frames = while_aiming(
        rig, visit, ANSWERS[code], lambda client: client.get(f"/api/preview?after=100000&visit={visit}&eye=OD")
    )
    time.sleep(ENOUGH_S)
    assert rig.world.frames <= frames + 1, "only the frame that was being exposed"
    assert rig.world.illumination is None
    assert answer.status_code == 204
    refused(rig.request("GET", f"/api/preview?after=100000&visit={visit}&eye=OD"), code)
    assert rig.request("GET", "/api/status").json()["problem"] is None


def test_pending_capture_gets_no_light_after_consent_is_withdrawn(make_rig: MakeRig) -> None:
    rig = make_rig()
    visit = visit_with_consent(rig)["id"]
    press = capture_request(visit)
    answer, frames = while_aiming(rig, visit, "declined", lambda client: client.post("/api/captures", json=press))
    refused(answer, "consent.declined")
    assert rig.world.frames <= frames + 1, "only the live frame that was being exposed"
    until(lambda: rig.exam.state == "aim")
    assert rig.store.captures() == []
    assert rig.world.illumination is None
    assert [data["stage"] for kind, data in rig.published_events() if kind == "stage"] == []
    assert rig.exam.capture_journal.interrupted == ()


def test_the_red_light_of_a_press_stays_off_after_consent_is_withdrawn(make_rig: MakeRig) -> None:
    """The consent is read before each light of a press, not once."""
    rig = make_rig(tinted=("green", "red"))
    visit = visit_with_consent(rig)["id"]
    wait_until_idle(rig)
    order = {"key": secrets.token_hex(8), "field": "consent", "value": "declined"}

    async def scenario(client: httpx.AsyncClient) -> httpx.Response:
        rig.block_exposures()
        press = asyncio.create_task(client.post("/api/captures", json=capture_request(visit)))
        await asyncio.to_thread(rig.wait_for_blocked_exposure)  # in the picture's colour
        assert (await client.patch(f"/api/visits/{visit}", json=order)).status_code == 200
        rig.clock.gate.set()
        return await press

    refused(rig.ask(scenario), "consent.declined")
    assert (rig.store.captures(), rig.world.illumination) == ([], None)
    assert rig.exam.capture_journal.interrupted == ()


def test_preview_of_another_visit_continues_when_consent_is_withdrawn(make_rig: MakeRig) -> None:
    rig = make_rig()
    first, second = (visit_with_consent(rig)["id"] for _ in range(2))
    answer, _ = while_aiming(
        rig, first, "declined", lambda client: client.get(f"/api/preview?after=0&visit={second}&eye=OS")
    )
    assert answer.status_code == 200


def test_capture_without_a_visit_stays_a_test_picture(old_rig: Rig) -> None:
    visit = visit_with_consent(old_rig)["id"]
    made = old_rig.request("POST", "/api/captures", json={"eye": "OD"}).json()
    of_visit = old_rig.request("POST", "/api/captures", json=capture_request(visit)).json()
    assert (made["test"], of_visit["test"]) == (True, False)
    assert (made["report"]["test"], of_visit["report"]["test"]) == (True, False)
    assert json.loads(old_rig.store.read(made["id"], "report.json"))["test"] is True
    before = old_rig.request("GET", f"/api/visits/{visit}").json()
    for path, more in (
        (f"/api/captures/{made['id']}/accept", {}),
        (f"/api/captures/{made['id']}/eye", {"eye": "OS"}),
        (f"/api/captures/{made['id']}/eye", {"eye": "OD"}),
        (f"/api/visits/{visit}/slots", {"slot": "R-centre", "capture": made["id"]}),
        (f"/api/visits/{visit}/slots", {"slot": "R-nerve", "capture": made["id"]}),
    ):
        answer = old_rig.request("POST", path, json={"key": secrets.token_hex(8), **more})
        assert (answer.status_code, answer.json()["code"]) == (404, "store.unknown")
        assert "test picture" in answer.json()["message"]
        assert "again" in answer.json()["remedy"]
    assert old_rig.request("GET", f"/api/visits/{visit}").json() == before
    assert old_rig.request("GET", f"/api/captures/{made['id']}").json() == made
    listed = {
        capture["id"]: capture["test"] for capture in old_rig.request("GET", "/api/captures?limit=2").json()["captures"]
    }
    assert listed == {made["id"]: True, of_visit["id"]: False}


def test_capture_of_an_earlier_release_without_a_visit_is_a_test_picture(old_rig: Rig) -> None:
    made = old_rig.store.get(old_rig.request("POST", "/api/captures", json={"eye": "OD"}).json()["id"])
    stored = made.report.as_json()
    earlier = CaptureReport.read({key: value for key, value in stored.items() if key not in ("visit", "slot", "test")})
    capture = type(made)(f"{made.id}-e", made.eye, made.taken_at, made.simulated, made.calibration_id, earlier, {})
    old_rig.store.save(capture, {"report.json": b"{}"})
    assert old_rig.request("GET", f"/api/captures/{capture.id}").json()["test"] is True
