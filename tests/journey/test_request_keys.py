"""The key of a request is bound to all of it: eye, visit and slot of a press, before and after a restart."""

from typing import Any

from device.clock import VirtualClock
from device.values import Capture, Eye
from services.records.people import People
from services.records.protocol import load_protocol
from services.records.store import Store
from services.records.underway import Lost, Underway
from tests.journey.asking import agreed_visit
from tests.journey.conftest import Rig

KEY, OTHER_KEY = "0123456789abcdef", "fedcba9876543210"


def pressed(rig: Rig, **body: Any) -> Any:
    return rig.request("POST", "/api/captures", json={"key": KEY, **body})


def begun(rig: Rig, key: str) -> str:
    return str(agreed_visit(rig, key)["id"])


def test_the_key_of_a_press_for_another_eye_visit_or_slot_is_refused_and_shines_no_light(rig: Any) -> None:
    first, second = begun(rig, "1" * 16), begun(rig, "2" * 16)
    asked = {"eye": "OD", "visit": first, "slot": "R-centre"}
    kept = pressed(rig, **asked)
    assert kept.status_code == 201
    others: list[dict[str, Any]] = [
        {"eye": "OD"}, {"eye": "OS"}, asked | {"visit": second}, asked | {"slot": "R-nerve"},
        asked | {"eye": "OS", "slot": "L-centre"},
    ]  # fmt: skip
    for other in others:
        answer = pressed(rig, **other)
        assert (answer.status_code, answer.json()["code"]) == (422, "input"), other
        assert "key: it belongs to another request" in answer.json()["message"]
    taken = pressed(rig, key="1" * 16, eye="OD")  # a key with which a visit was begun
    assert (taken.status_code, taken.json()["message"]) == (422, "key: it belongs to another request")
    assert pressed(rig, **asked).json()["id"] == kept.json()["id"]
    assert [one.id for one in rig.store.captures()] == [kept.json()["id"]]


def test_a_key_is_bound_while_its_picture_is_made(rig: Any) -> None:
    rig.hang()
    first = rig.exam.press("OD", KEY)
    assert rig.exam.press("OD", KEY) is first
    answer = pressed(rig, eye="OS")
    rig.clock.gate.set()
    assert (answer.status_code, answer.json()["message"]) == (422, "key: it belongs to another request")
    assert first.result(30).eye == "OD"


def test_a_picture_that_was_moved_still_answers_the_press_that_made_it(tmp_path: Any) -> None:
    """Also by a key as an earlier release wrote it down: of every press the same word."""
    clock = VirtualClock()
    with Store(tmp_path, reserve_bytes=0) as store:
        people = People(store.engine, load_protocol(), clock)
        visit = people.answer("3" * 16, people.begin("1" * 16).id, "consent", "agreed").id
        keep(store, people, "c1", "OD", visit)
        people.move("2" * 16, "c1", "OS", None)
        assert store.get("c1").eye == "OS"
        assert people.answered(KEY, "OD", visit, "R-centre") == "c1"
        assert people.answered(OTHER_KEY, "OD", visit, "R-centre") is None


def keep(store: Store, people: People, id: str, eye: Eye, visit: str) -> None:
    errand = people.errand(eye, KEY, visit, "R-centre")
    taken = Capture(id, eye, people.clock.wall(), True, "00ff", errand.facts | {"verdict": None}, {})
    store.keep(taken, {"raw.tiff": b"raw"}, errand.beside)


def test_what_a_kill_took_is_over_when_its_key_was_answered_after_all(tmp_path: Any) -> None:
    lost, other = Lost("20260301T120000-OD-ab", "OD"), Lost("20260301T120001-OS-cd", "OS")
    with Store(tmp_path, reserve_bytes=0) as store:
        before = Underway(store)
        before.begin(lost, KEY)
        before.begin(other, OTHER_KEY)
        again = Underway(store)
        assert again.lost == (lost, other)
        again.end("20260301T120002-OD-ef", KEY)
        assert again.lost == (other,)
        assert Underway(store).lost == (other,)
