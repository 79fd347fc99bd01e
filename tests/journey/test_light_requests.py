"""Requests of light: counted for the named eye, limited without a visit, live pictures with the control lease."""

import secrets
import time
from typing import Any

import pytest

from device.light_safety.guard import GuardedLight
from device.values import Eye
from services.health.probe import probe_instrument
from services.http.authentication import OWN_SCREEN
from services.http.connection_limits import ConnectionLimits
from services.identity.logins import IDLE_LOCK_S
from services.identity.users import ROLES
from tests.journey.asking import post_capture, status_problem, visit_with_consent
from tests.journey.conftest import MakeRig, Rig
from tests.journey.faults import wait_until_idle
from tests.journey.serving import served

PIN = "274913"
OTHER_EYE: dict[Eye, Eye] = {"OD": "OS", "OS": "OD"}
SLOTS: dict[Eye, str] = {"OD": "R-centre", "OS": "L-centre"}


def light_of(rig: Rig) -> GuardedLight:
    light = rig.exam.head.light
    assert isinstance(light, GuardedLight)
    return light


def doses_j_per_cm2(rig: Rig) -> dict[Eye, float]:
    wait_until_idle(rig)  # a live picture may have a reservation
    return {eye: light_of(rig).ledger.spent_j_per_cm2(eye) for eye in ("OD", "OS")}


def live_status(rig: Rig, query: str = "", key: str | None = None) -> int:
    """Return the status of a request of a live picture, repeated while none comes in time on a busy computer."""
    headers = {} if key is None else {"X-Controller": key}
    for _ in range(20):
        status = rig.request("GET", f"/api/preview?after=0{query}", headers=headers).status_code
        if status != 204:
            return status
    return 204


def spend_share_without_visit(rig: Rig, eye: Eye) -> None:
    """Charge an eye with the whole dose that light without a visit may give."""
    limits, ledger = light_of(rig).hazard.limits, light_of(rig).ledger
    rest_j_per_cm2 = limits.stop_without_visit_j_per_cm2 - ledger.spent_j_per_cm2(eye)
    ledger.reserve((eye,), rest_j_per_cm2, limits.stop_j_per_cm2)


def slot_of(rig: Rig, eye: Eye, in_visit: bool) -> dict[str, str]:
    """Return visit and slot of a press, empty for a test picture."""
    return {"visit": visit_with_consent(rig)["id"], "slot": SLOTS[eye]} if in_visit else {}


@pytest.mark.parametrize("in_visit", [False, True])
@pytest.mark.parametrize("eye", ["OD", "OS"])
def test_all_light_is_counted_for_the_named_eye(make_rig: MakeRig, eye: Eye, in_visit: bool) -> None:
    rig = make_rig()
    slot = slot_of(rig, eye, in_visit)
    visit = f"&visit={slot['visit']}" if in_visit else ""
    doses = [doses_j_per_cm2(rig)]
    assert post_capture(rig, eye, **slot).way == "verdict"
    doses.append(doses_j_per_cm2(rig))
    assert live_status(rig, f"&eye={eye}{visit}") == 200
    doses.append(doses_j_per_cm2(rig))
    assert doses[0][eye] < doses[1][eye] < doses[2][eye]
    assert len({dose[OTHER_EYE[eye]] for dose in doses}) == 1


def test_light_without_a_visit_ends_while_a_visit_gets_light(make_rig: MakeRig) -> None:
    rig = make_rig()
    slot = slot_of(rig, "OD", True)
    wait_until_idle(rig)
    spend_share_without_visit(rig, "OD")
    frames = rig.world.frames
    refused = post_capture(rig)
    assert (refused.way, refused.code) == ("423", "light.visit")
    assert "Begin a visit" in refused.remedy
    assert status_problem(rig).code == "light.visit"
    assert rig.request("GET", "/api/preview?after=0&eye=OD").status_code == 204
    assert (rig.world.frames, rig.world.illumination) == (frames + 1, None), "its dark frame alone"
    assert post_capture(rig, "OS").way == "verdict", "the other eye has its own limit"
    assert post_capture(rig, "OD", **slot).way == "verdict"
    assert live_status(rig, f"&eye=OD&visit={slot['visit']}") == 200


def request_lease(rig: Rig, key: str, **more: Any) -> bool:
    """Request the control lease; return whether the screen holds it now."""
    return bool(rig.request("POST", "/api/controller", json={"key": key} | more).json()["mine"])


@pytest.mark.parametrize("ends_by", ["sign-out", "idle lock"])
def test_the_lamp_goes_dark_when_the_user_is_signed_out_or_idle(make_rig: MakeRig, ends_by: str) -> None:
    """No request but those of the user lights the lamp; the exam and its visit stay as they are."""
    rig = make_rig()
    visit = visit_with_consent(rig)["id"]
    rig.authenticator.users.add("Asha", PIN, ROLES)
    login = {"Cookie": f"login={rig.authenticator.sign_in('Asha', PIN, OWN_SCREEN)}"}

    def status(method: str, path: str) -> int:
        for _ in range(20):  # while no picture comes in time on a busy computer
            code = int(rig.request(method, path, headers=login | {"X-Controller": "1" * 16}).status_code)
            if code != 204:
                break
        return code

    live = f"/api/preview?after=0&eye=OD&visit={visit}"
    assert status("GET", live) == 200
    if ends_by == "sign-out":
        assert status("DELETE", "/api/login") == 200
    else:
        rig.clock.elapsed_s += IDLE_LOCK_S
    assert status("GET", live) == 401
    frames = 0
    while frames != rig.world.frames:  # a dark frame and a live picture that had begun end first
        frames = rig.world.frames
        time.sleep(1.0)
    given = doses_j_per_cm2(rig)
    for method, path in (("GET", live), ("POST", "/api/captures"), ("POST", "/api/calibration")):
        assert status(method, path) == 401
    wait_until_idle(rig)
    assert doses_j_per_cm2(rig)["OD"] <= given["OD"], "the last reservation may have been settled since"
    assert rig.request("GET", "/api/status").json()["state"] == "aim"
    login["Cookie"] = f"login={rig.authenticator.sign_in('Asha', PIN, OWN_SCREEN)}"
    assert status("GET", f"/api/visits/{visit}") == 200
    assert status("GET", live) == 200


def test_a_user_who_is_removed_in_an_exam_gets_no_more_light_and_another_one_continues(make_rig: MakeRig) -> None:
    rig = make_rig()
    visit = visit_with_consent(rig)["id"]
    users = rig.authenticator.users
    for name, roles in (("Asha", ROLES), ("Ravi", ROLES[:1])):
        users.add(name, PIN, roles)
    asha, ravi = ({"Cookie": f"login={rig.authenticator.sign_in(name, PIN, OWN_SCREEN)}"} for name in ("Asha", "Ravi"))
    picture = {"eye": "OD", "visit": visit, "slot": "R-centre", "key": "1" * 16}
    users.remove("Ravi")
    assert rig.request("POST", "/api/captures", json=picture, headers=ravi).status_code == 401
    assert rig.request("GET", f"/api/preview?after=0&eye=OD&visit={visit}", headers=ravi).status_code == 401
    assert (rig.world.illumination, doses_j_per_cm2(rig)["OD"]) == (None, 0)
    assert rig.request("POST", "/api/captures", json=picture, headers=asha).status_code == 201


LIT_BY: dict[str, dict[str, Any]] = {
    "/api/captures": {"eye": "OD"},
    "/api/calibration": {"serial": "1", "by": "A", "source_deg": 0.1},
    "/api/calibration/trial-lenses": {"vertex_mm": 12, "eye_dpt": 0},
}


def test_light_needs_the_control_lease(make_rig: MakeRig) -> None:
    rig, mine, other = make_rig(), secrets.token_hex(8), secrets.token_hex(8)
    assert live_status(rig) == 200, "without a key while no screen holds the lease"
    assert request_lease(rig, mine)
    wait_until_idle(rig)
    frames = rig.world.frames
    strangers: tuple[dict[str, str], ...] = ({}, {"X-Controller": other})
    for headers in strangers:
        answer = rig.request("GET", "/api/preview?after=0&eye=OD", headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (409, "link.other")
        for path, body in LIT_BY.items():
            answer = rig.request("POST", path, json=body, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (409, "link.other"), path
    assert rig.world.frames == frames
    assert live_status(rig, key=mine) == 200
    press = rig.request("POST", "/api/captures", json=LIT_BY["/api/captures"], headers={"X-Controller": mine})
    assert press.status_code == 201
    assert request_lease(rig, other, take=True)
    assert live_status(rig, key=mine) == 409


def test_a_live_picture_acquires_a_free_lease(make_rig: MakeRig) -> None:
    rig, mine, other = make_rig(), secrets.token_hex(8), secrets.token_hex(8)
    assert live_status(rig, key=mine) == 200
    assert not request_lease(rig, other)


def test_the_probe_takes_a_live_picture_although_a_screen_holds_the_lease(make_rig: MakeRig) -> None:
    rig, screen = make_rig(), secrets.token_hex(8)
    assert request_lease(rig, screen)
    with served(rig.app, ConnectionLimits()) as (port,):
        checks = {check.name: check for check in probe_instrument(f"http://127.0.0.1:{port}", with_picture=True)}
        rig.event_bus.close()
    assert checks["picture"].ok, checks["picture"].value
    rig.clock.elapsed_s += 3
    assert request_lease(rig, screen), "the probe released the lease"
