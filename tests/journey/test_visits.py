"""Visits over HTTP: from a number to an outcome, with invalid, hostile, repeated and concurrent requests."""

import asyncio
import json
from itertools import count
from socket import gethostname
from typing import Any

import httpx
import pytest

from device.sim import calibration_targets
from services.http.security import is_trusted_host
from services.instrument.exam_requests import WANTED_S
from tests.journey.asking import record_answer
from tests.journey.conftest import until

SLOTS = ["R-centre", "R-nerve", "L-centre", "L-nerve"]
EYES = {"R-centre": "OD", "R-nerve": "OD", "L-centre": "OS", "L-nerve": "OS"}
JSON = {"Content-Type": "application/json"}
keys = (f"{number:016x}" for number in count(1))
HOSTILE = [
    "<script>alert(1)</script>",
    "'; DROP TABLE patients; --",
    '"><img src=x onerror=alert(1)>',
    "../../etc/passwd",
    "{{7*7}}",
    "\u202egnp.exe",
    "மீனாட்சி சுந்தரம்",
    "a\x00b",
    "\r\nSet-Cookie: a=b",
    "😀" * 60,
    "NULL",
    "%s%n",
]


def refused(answer: httpx.Response, status: int, code: str) -> dict[str, str]:
    assert answer.status_code == status, answer.text
    words: dict[str, str] = answer.json()
    assert set(words) == {"code", "message", "remedy"}
    assert words["code"] == code
    assert all(words.values())
    return words


def post(rig: Any, path: str, **body: Any) -> Any:
    answer = rig.request("POST", path, json={"key": next(keys), **body})
    assert answer.status_code in (200, 201), answer.text
    return answer.json()


def begin(rig: Any, number: str | None = None) -> Any:
    return post(rig, "/api/visits", **({} if number is None else {"number": number}))


def patch(rig: Any, visit: Any, field: str, value: Any) -> httpx.Response:
    body = json.dumps(
        {"key": next(keys), "field": field, "value": value}
    )  # escaped, so that a lone surrogate can be sent
    answer: httpx.Response = rig.request("PATCH", f"/api/visits/{visit['id']}", content=body, headers=JSON)
    return answer


def agreed(rig: Any) -> Any:
    """Begin a visit with consent."""
    return patch(rig, begin(rig), "consent", "agreed").json()


def shoot(rig: Any, visit: Any, slot: str) -> Any:
    return post(rig, "/api/captures", eye=EYES[slot], visit=visit["id"], slot=slot)


def test_a_complete_visit_from_number_to_outcome(old_rig: Any) -> None:
    assert [slot["id"] for slot in old_rig.request("GET", "/api/programme").json()["slots"]] == SLOTS
    visit = begin(old_rig)
    assert visit["number"].startswith("A")
    assert visit["next_slot"] == "R-centre"
    assert {slot["state"] for slot in visit["slots"].values()} == {"empty"}
    for field, value in {"consent": "agreed", "age": 54, "sex": "woman", "vision_od": "6/12"}.items():
        assert patch(old_rig, visit, field, value).json()["fields"][field] == value
    for slot in SLOTS:
        made = shoot(old_rig, visit, slot)
        assert (made["visit"], made["slot"], made["eye"]) == (visit["id"], slot, EYES[slot])
    now = old_rig.request("GET", f"/api/visits/{visit['id']}").json()
    assert now["next_slot"] is None
    assert {slot["tries"] for slot in now["slots"].values()} == {1}
    ended = post(old_rig, f"/api/visits/{visit['id']}/finish")
    assert ended["outcome"]["code"] == "send"
    assert ended["finished_at"]
    assert ended["undo_until"] > ended["finished_at"]
    listed = old_rig.request("GET", f"/api/visits?day={visit['day']}").json()
    assert listed["visits"][0] == ended
    assert listed["counts"]["done"] >= 1


def test_a_retake_keeps_the_old_picture_and_the_user_chooses(old_rig: Any) -> None:
    visit = agreed(old_rig)
    first, second = shoot(old_rig, visit, "R-centre"), shoot(old_rig, visit, "R-centre")
    slot = old_rig.request("GET", f"/api/visits/{visit['id']}").json()["slots"]["R-centre"]
    assert slot["captures"] == [first["id"], second["id"]]
    assert slot["capture"] == second["id"]  # the newest of two that are equally good
    kept = post(old_rig, f"/api/captures/{first['id']}/accept")
    assert kept["slots"]["R-centre"]["capture"] == first["id"]
    emptied = post(old_rig, f"/api/visits/{visit['id']}/slots", slot="R-centre", capture=None)
    assert emptied["slots"]["R-centre"]["state"] == "empty"
    assert emptied["next_slot"] == "R-centre"
    assert emptied["slots"]["R-centre"]["captures"] == [first["id"], second["id"]]
    back = post(old_rig, f"/api/visits/{visit['id']}/slots", slot="R-centre", capture=second["id"])
    assert back["slots"]["R-centre"]["capture"] == second["id"]


def live(rig: Any, after: int) -> Any:
    """Return the next live picture; repeats the request as a page does."""
    while (answer := rig.request("GET", f"/api/preview?after={after}")).status_code == 204:
        pass
    return answer


def test_a_wall_instead_of_an_eye_is_reported_before_the_reconstruction(make_rig: Any) -> None:
    rig = make_rig()
    visit = agreed(rig)
    requested_s = rig.clock.now_s()
    aim = json.loads(rig.request("GET", "/api/preview").headers["x-aim"])
    assert aim == {"code": "ready", "fill": pytest.approx(0.98, abs=0.03)}
    until(lambda: rig.clock.now_s() >= requested_s + WANTED_S and rig.world.illumination is None)
    rig.clock.elapsed_s += 60  # with the lamp off; so that the wall does not count as the lid of the earlier eye
    rig.world.faults.add("eye.closed")  # a wall reflects uniformly, as a lid does
    causes = [shoot(rig, visit, "R-centre")["verdict"] for _ in range(4)]
    assert {cause["word"] for cause in causes} == {"again"}
    assert [cause["code"] for cause in causes] == ["shot.noeye"] * 2 + ["shot.poor"] * 2
    slot = rig.request("GET", f"/api/visits/{visit['id']}").json()["slots"]["R-centre"]
    assert (slot["state"], slot["tries"]) == ("taken", 4)  # the poor picture, never an empty slot
    assert slot["verdict"]["code"] == "shot.poor"
    events = [
        (kind, data.get("word"), data.get("code"))
        for kind, data in rig.published_events()
        if kind in ("verdict", "stage")
    ]
    assert events.index(("verdict", "again", "shot.noeye")) < 3  # before the reconstruction
    number = int(live(rig, 0).headers["x-frame"])
    assert json.loads(live(rig, number).headers["x-aim"]) == {"code": "noeye", "fill": 0.0}
    rig.world.faults.clear()
    assert shoot(rig, visit, "R-centre")["verdict"]["word"] == "good"
    assert rig.request("GET", f"/api/visits/{visit['id']}").json()["slots"]["R-centre"]["verdict"]["word"] == "good"
    aims = [data for kind, data in rig.published_events() if kind == "aim"]
    assert [data["code"] for data in aims][:2] == ["ready", "noeye"]


def test_saturation_is_reported_without_a_reconstruction(make_rig: Any) -> None:
    rig = make_rig()
    rig.world.target = calibration_targets.screen(rig.world, 1e9)
    answer = rig.request("POST", "/api/captures", json={"eye": "OD", "key": next(keys)})
    assert answer.status_code == 201
    assert answer.json()["verdict"]["code"] == "shot.saturated"
    events = [(kind, data.get("code")) for kind, data in rig.published_events() if kind in ("verdict", "failed")]
    assert events == [("verdict", "shot.saturated")]


def test_a_live_picture_that_is_too_bright_is_a_hint_and_no_problem(make_rig: Any) -> None:
    """The worker moves back and presses: a problem would disable the button, in words for a technician."""
    rig = make_rig()
    rig.world.target = calibration_targets.screen(rig.world, 1e9)
    answer = rig.request("GET", "/api/preview")
    assert answer.status_code == 200
    assert json.loads(answer.headers["x-aim"])["code"] == "bright"
    assert rig.request("GET", "/api/status").json()["problem"] is None


def test_a_visit_without_possible_pictures_can_be_finished(old_rig: Any) -> None:
    visit = begin(old_rig)
    for slot, reason in zip(SLOTS, ["pupil", "cloudy", "still", "refused"], strict=True):
        answer = post(old_rig, f"/api/visits/{visit['id']}/not-possible", slot=slot, reason=reason)
        assert answer["slots"][slot]["state"] == "not_possible"
        assert answer["slots"][slot]["reason"] == reason
    ended = post(old_rig, f"/api/visits/{visit['id']}/finish")
    assert (ended["outcome"]["code"], ended["outcome"]["urgency"]) == ("refer_picture", "soon")
    assert [reason["value"] for reason in ended["outcome"]["reasons"]] == ["pupil", "cloudy", "still", "refused"]
    where = f"/api/visits/{visit['id']}/not-possible"
    refused(
        old_rig.request("POST", where, json={"key": next(keys), "slot": "R-centre", "reason": "pupil"}),
        409,
        "visit.finished",
    )


def test_a_finish_can_be_undone_on_the_same_day_of_the_instruments_clock(old_rig: Any) -> None:
    visit = begin(old_rig)
    post(old_rig, f"/api/visits/{visit['id']}/finish")
    refused(patch(old_rig, visit, "age", 5), 409, "visit.finished")
    press = {"key": next(keys), "eye": "OD", "visit": visit["id"], "slot": "R-centre"}
    refused(old_rig.request("POST", "/api/captures", json=press), 409, "visit.finished")
    opened = post(old_rig, f"/api/visits/{visit['id']}/reopen", reason="answer")
    assert opened["finished_at"] is opened["outcome"] is opened["undo_until"] is None
    assert patch(old_rig, visit, "age", 5).status_code == 200
    assert post(old_rig, f"/api/visits/{visit['id']}/finish")["undo_until"]
    old_rig.clock.elapsed_s += 86400
    assert old_rig.request("GET", f"/api/visits/{visit['id']}").json()["undo_until"] is None
    late = old_rig.request("POST", f"/api/visits/{visit['id']}/reopen", json={"key": next(keys), "reason": "answer"})
    refused(late, 409, "visit.finished")


def test_the_history_of_a_visit_keeps_what_was_who_changed_it_and_why(old_rig: Any) -> None:
    visit = begin(old_rig)
    at = f"/api/visits/{visit['id']}"
    for field, value in (("vision_od", "6/60"), ("vision_od", "6/6"), ("vision_od", "6/6"), ("name", "Meena")):
        assert patch(old_rig, visit, field, value).status_code == 200
    post(old_rig, f"{at}/finish")
    without_reason = old_rig.request("POST", f"{at}/reopen", json={"key": next(keys)})
    assert without_reason.status_code == 422
    assert old_rig.request("GET", at).json()["finished_at"] is not None
    post(old_rig, f"{at}/reopen", reason="answer")
    changes = old_rig.request("GET", f"{at}/changes").json()["changes"]
    assert [(one["number"], one["user"], one["field"], one["was"], one["value"], one["why"]) for one in changes] == [
        (1, "Demo", "vision_od", None, "6/60", None),
        (2, "Demo", "vision_od", "6/60", "6/6", None),
        (3, "Demo", "name", None, "Meena", None),
        (4, "Demo", "outcome", None, "refer_picture", None),
        (5, "Demo", "outcome", "refer_picture", None, "answer"),
    ]
    assert [one["at"] for one in changes] == sorted(one["at"] for one in changes)
    assert old_rig.request("GET", "/api/visits/none/changes").status_code == 404


def test_a_known_number_is_the_same_patient_with_or_without_the_prefix(old_rig: Any) -> None:
    first = begin(old_rig)
    assert patch(old_rig, first, "name", "Meena").json()["fields"]["name"] == "Meena"
    again = begin(old_rig, first["number"])
    assert again["id"] != first["id"]
    assert again["fields"]["name"] == "Meena"  # of the patient; other answers belong to the visit
    assert begin(old_rig, first["number"][1:])["number"] == first["number"]
    assert begin(old_rig, " camp-7 ")["number"] == "CAMP-7"
    found = old_rig.request("GET", f"/api/visits?q={first['number'][1:]}").json()["visits"]
    assert len(found) == 3
    wrong = first["number"][:-1] + str((int(first["number"][-1]) + 1) % 10)
    answer = refused(old_rig.request("POST", "/api/visits", json={"key": next(keys), "number": wrong}), 422, "input")
    assert "mistyped" in answer["message"]


def test_a_repeated_request_changes_nothing_even_after_a_restart(make_rig: Any) -> None:
    rig = make_rig()
    key, pressed = next(keys), next(keys)
    visit = rig.request("POST", "/api/visits", json={"key": key}).json()
    patch(rig, visit, "consent", "agreed")
    press = {"key": pressed, "eye": "OD", "visit": visit["id"], "slot": "R-centre"}
    made = rig.request("POST", "/api/captures", json=press).json()
    rig.exam.close()
    restarted = make_rig()
    assert restarted.request("POST", "/api/visits", json={"key": key}).json()["id"] == visit["id"]
    assert restarted.request("POST", "/api/captures", json=press).json() == made
    assert len(restarted.request("GET", "/api/visits").json()["visits"]) == 1
    assert len(restarted.store.captures()) == 1
    answer = restarted.request("POST", f"/api/visits/{visit['id']}/finish", json={"key": key})
    assert "another request" in refused(answer, 409, "refused.key")["message"]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_is_stored_unchanged(old_rig: Any, text: str) -> None:
    visit = begin(old_rig)
    for field in ("name", "village"):
        answer = patch(old_rig, visit, field, text[:120])
        assert answer.json()["fields"][field] == text[:120]
        assert answer.headers["content-type"] == "application/json"
    assert old_rig.request("GET", f"/api/visits/{visit['id']}").json()["fields"]["name"] == text[:120]
    assert patch(old_rig, visit, "name", None).json()["fields"].get("name") is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", "x" * 121),
        ("phone", "1" * 41),
        ("village", "v" * 5000),
        ("name", "\ud800"),
        ("name", "  "),
        ("name", 7),
        ("name", ["a"]),
        ("age", -1),
        ("age", 126),
        ("age", "54"),
        ("age", True),
        ("age", 10**30),
        ("sex", "f"),
        ("consent", "yes"),
        ("diabetes", True),
        ("vision_od", "6/7"),
        ("vision_os", 6),
        ("complaints", ["none", "pain"]),
        ("complaints", ["pain", "pain"]),
        ("complaints", "pain"),
        ("drops_od", "noon"),
        ("drops_os", "٠٩:٤٠"),
        ("diabetes_years", "m" * 21),
        ("id", "x"),
        ("outcome", "send"),
        ("\ud800", 1),
    ],
)
def test_an_invalid_answer_is_422_with_a_remedy_and_changes_nothing(old_rig: Any, field: str, value: Any) -> None:
    visit = begin(old_rig)
    refused(patch(old_rig, visit, field, value), 422, "input")
    assert old_rig.request("GET", f"/api/visits/{visit['id']}").json() == visit


def test_every_form_field_stores_and_returns_its_answers(old_rig: Any) -> None:
    visit = begin(old_rig)
    answers = {
        "consent": "declined",
        "age": 0,
        "sex": "other",
        "diabetes": "unknown",
        "diabetes_years": "5-10",
        "vision_od": "6/60",
        "vision_os": "NLP",
        "glasses": "yes",
        "drops_od": "09:40",
        "drops_os": "2026-03-01T09:40:00Z",
        "complaints": ["flashes", "red"],
        "name": "N",
        "phone": "+91 1",
        "village": "V",
    }
    for field, value in answers.items():
        assert patch(old_rig, visit, field, value).status_code == 200
    assert old_rig.request("GET", f"/api/visits/{visit['id']}").json()["fields"] == answers
    for field in answers:
        assert patch(old_rig, visit, field, [] if field == "complaints" else None).status_code == 200
    left = dict.fromkeys(answers.keys() - {"name", "phone", "village"})  # identifying fields are removed completely
    assert old_rig.request("GET", f"/api/visits/{visit['id']}").json()["fields"] == left
    assert post(old_rig, f"/api/visits/{visit['id']}/finish")["outcome"]["code"] == "refer_picture"
    post(old_rig, f"/api/visits/{visit['id']}/reopen", reason="answer")
    for urgent in ("sudden_loss", "pain"):
        patch(old_rig, visit, "complaints", [urgent])
        assert post(old_rig, f"/api/visits/{visit['id']}/finish")["outcome"]["code"] == "refer_today"
        post(old_rig, f"/api/visits/{visit['id']}/reopen", reason="answer")


@pytest.mark.parametrize("number", ["x" * 21, "../a", "a b", "", "\ud800", "<b>", "A00012", "٣٤"])
def test_an_invalid_number_is_422(old_rig: Any, number: str) -> None:
    before = old_rig.request("GET", "/api/visits").json()
    body = json.dumps({"key": next(keys), "number": number})
    refused(old_rig.request("POST", "/api/visits", content=body, headers=JSON), 422, "input")
    assert old_rig.request("GET", "/api/visits").json() == before


def test_inconsistent_requests_are_refused(old_rig: Any) -> None:
    visit, other = agreed(old_rig), begin(old_rig)
    made = shoot(old_rig, visit, "R-centre")
    alone = post(old_rig, "/api/captures", eye="OD")
    assert alone["visit"] is alone["slot"] is None

    def ask(status: int, code: str, path: str, **body: Any) -> None:
        refused(old_rig.request("POST", path, json={"key": next(keys), **body}), status, code)

    at = f"/api/visits/{visit['id']}"
    ask(422, "input", "/api/captures", eye="OS", visit=visit["id"], slot="R-centre")
    ask(422, "input", "/api/captures", eye="OD", visit=visit["id"])
    ask(404, "store.unknown", "/api/captures", eye="OD", visit="unknown", slot="R-centre")
    ask(404, "store.unknown", "/api/captures", eye="OD", visit=visit["id"], slot="R-corner")
    ask(404, "store.unknown", f"/api/captures/{alone['id']}/accept")
    ask(404, "store.unknown", f"/api/visits/{other['id']}/slots", slot="R-centre", capture=made["id"])
    ask(404, "store.unknown", f"{at}/slots", slot="R-nerve", capture=made["id"])
    ask(404, "store.unknown", f"{at}/not-possible", slot="R-corner", reason="pupil")
    ask(422, "input", f"{at}/not-possible", slot="R-nerve", reason="lazy")
    ask(404, "store.unknown", "/api/visits/unknown/finish")
    ask(404, "store.unknown", "/api/visits/%00%ff/finish")
    refused(old_rig.request("GET", "/api/visits?day=today"), 422, "input")
    refused(old_rig.request("GET", "/api/visits?day=0"), 422, "input")  # no seconds since 1970
    refused(old_rig.request("GET", "/api/visits?q=%25"), 422, "input")
    refused(old_rig.request("GET", "/api/visits?limit=0"), 422, "input")


def test_the_list_is_filtered_by_day_state_and_digits(make_rig: Any) -> None:
    rig = make_rig()
    first = begin(rig)
    rig.clock.elapsed_s += 1
    second = begin(rig)
    rig.clock.elapsed_s += 86400
    third = begin(rig)
    post(rig, f"/api/visits/{first['id']}/finish")

    def listed(query: str) -> list[str]:
        return [visit["number"] for visit in rig.request("GET", f"/api/visits{query}").json()["visits"]]

    assert listed("") == [third["number"], second["number"], first["number"]]
    assert listed("?limit=1") == [third["number"]]
    assert listed(f"?day={first['day']}") == [second["number"], first["number"]]
    assert listed("?open=true") == [third["number"], second["number"]]
    assert listed("?open=false") == [first["number"]]
    assert listed(f"?q={third['number'][1:]}") == [third["number"]]
    counts = rig.request("GET", f"/api/visits?day={first['day']}").json()["counts"]
    assert counts == {"done": 1, "to_finish": 1, "referred": 1, "declined": 0}  # no picture of either eye
    record_answer(rig, second["id"], "consent", "declined")
    post(rig, f"/api/visits/{second['id']}/finish")
    counts = rig.request("GET", f"/api/visits?day={first['day']}").json()["counts"]
    assert counts == {"done": 2, "to_finish": 0, "referred": 1, "declined": 1}  # a refusal is no referral


def test_one_screen_at_a_time_takes_pictures(old_rig: Any) -> None:
    mine, other = {"X-Controller": next(keys)}, {"X-Controller": next(keys)}
    asked = post(old_rig, "/api/controller", key=mine["X-Controller"])
    assert asked["mine"] is True
    assert asked["lease"] == old_rig.request("GET", "/api/status").json()["controller"]
    assert asked["lease"] not in mine.values()  # public name, not the key
    assert post(old_rig, "/api/controller", key=other["X-Controller"]) == {"lease": asked["lease"], "mine": False}
    for path, body in {"/api/captures": {"eye": "OD"}, "/api/visits": {}}.items():
        answer = refused(
            old_rig.request("POST", path, json={"key": next(keys), **body}, headers=other), 409, "link.other"
        )
        assert answer["remedy"] == "Another tablet is using the camera."
        assert old_rig.request("POST", path, json={"key": next(keys), **body}, headers=mine).status_code == 201
    begin(old_rig)  # without the header: a script
    taken = post(old_rig, "/api/controller", key=other["X-Controller"], take=True)
    assert taken["mine"] is True
    body = {"key": next(keys)}
    refused(old_rig.request("POST", "/api/visits", json=body, headers=mine), 409, "link.other")
    old_rig.clock.elapsed_s += 9
    old_rig.request("GET", "/api/visits", headers=other)  # each request renews the lease
    old_rig.clock.elapsed_s += 9
    refused(old_rig.request("POST", "/api/visits", json=body, headers=mine), 409, "link.other")
    old_rig.clock.elapsed_s += 10
    assert old_rig.request("GET", "/api/status").json()["controller"] is None
    assert old_rig.request("POST", "/api/visits", json=body, headers=mine).status_code == 201


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://diffuscope.local:81", "https://[", "http://diffuscope.localx"]
)
def test_a_cross_origin_change_is_403(old_rig: Any, origin: str) -> None:
    before = old_rig.request("GET", "/api/visits").json()
    for method, path in {"POST": "/api/visits", "PATCH": "/api/visits/x", "DELETE": "/api/visits/x"}.items():
        answer = old_rig.request(method, path, json={"key": next(keys)}, headers={"Origin": origin})
        refused(answer, 403, "link.forged")
        assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert old_rig.request("GET", "/api/visits").json() == before
    own = {"Origin": "http://diffuscope.local"}
    assert old_rig.request("POST", "/api/visits", json={"key": next(keys)}, headers=own).status_code == 201


def test_untrusted_host_names_are_refused(old_rig: Any) -> None:
    def status(host: str) -> int:
        return int(old_rig.request("GET", "/api/health", headers={"Host": host}).status_code)

    own = ["127.0.0.1:8000", "[::1]:8000", "localhost:8000", "diffuscope.local", "DIFFUSCOPE.LOCAL:80"]
    own.append(f"{gethostname()}.local")
    assert {host: status(host) for host in own} == dict.fromkeys(own, 200)
    foreign = [
        "evil.example",
        "diffuscope.local.evil.example",
        "localhost.evil.example",
        "diffuscope.local:x",
        "[",
        "other.local",
        "10.42.0.1",
        "8.8.8.8",
        "10.42.0.1.evil",
        "",
    ]
    assert {host: status(host) for host in foreign} == dict.fromkeys(foreign, 400)
    refused(old_rig.request("GET", "/", headers={"Host": "evil.example"}), 400, "link.host")


@pytest.mark.parametrize("address", ["10.42.0.1", "::ffff:10.42.0.1"])
def test_the_address_that_a_connection_came_to_is_a_name(address: str) -> None:
    """No other one: the address of a router that forwards a port is no name of the device."""
    assert is_trusted_host("10.42.0.1:8000", frozenset(), address)
    assert not is_trusted_host("10.42.0.2:8000", frozenset(), address)
    assert not is_trusted_host("10.42.0.1", frozenset(), "/run/socket")


def test_many_tabs_at_once_get_different_numbers(old_rig: Any) -> None:
    async def requests(client: httpx.AsyncClient) -> list[httpx.Response]:
        return await asyncio.gather(*(client.post("/api/visits", json={"key": next(keys)}) for _ in range(8)))

    answers = old_rig.ask(requests)
    assert [answer.status_code for answer in answers] == [201] * 8
    assert len({answer.json()["number"] for answer in answers}) == 8


def test_the_free_space_is_given_in_visits(make_rig: Any) -> None:
    rig = make_rig(store={"free_bytes": lambda _: 40_000_000 * 12})
    assert rig.request("GET", "/api/status").json()["people_left"] == 12  # four pictures each, of ten million bytes
    visit = agreed(rig)
    used = sum(
        (rig.store.folder / "captures" / made["id"] / name).stat().st_size
        for made in [shoot(rig, visit, slot) for slot in SLOTS[:2]]
        for name in made["files"]
    )
    half = rig.request("GET", "/api/status").json()["people_left"]
    assert half == 480_000_000 // (used // 2) // 4  # an open visit with two pictures will have four
    post(rig, f"/api/visits/{visit['id']}/finish")
    assert rig.request("GET", "/api/status").json()["people_left"] == 480_000_000 // used
