"""Idempotency keys of capture requests: bound to eye, visit and slot, before and after a restart."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from device.clock import VirtualClock
from device.values import Eye
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.visit_repository import VisitRepository
from tests.journey.asking import visit_with_consent
from tests.journey.conftest import Rig

KEY, OTHER_KEY = "0123456789abcdef", "fedcba9876543210"


def post_capture(rig: Rig, **body: Any) -> Any:
    return rig.request("POST", "/api/captures", json={"key": KEY, **body})


def start_visit(rig: Rig, key: str) -> str:
    return str(visit_with_consent(rig, key)["id"])


def test_an_idempotency_key_of_another_eye_visit_or_slot_is_refused_without_light(rig: Any) -> None:
    first, second = start_visit(rig, "1" * 16), start_visit(rig, "2" * 16)
    request_body = {"eye": "OD", "visit": first, "slot": "R-centre"}
    kept = post_capture(rig, **request_body)
    assert kept.status_code == 201
    others: list[dict[str, Any]] = [
        {"eye": "OD"},
        {"eye": "OS"},
        request_body | {"visit": second},
        request_body | {"slot": "R-nerve"},
        request_body | {"eye": "OS", "slot": "L-centre"},
    ]
    for other in others:
        answer = post_capture(rig, **other)
        assert (answer.status_code, answer.json()["code"]) == (409, "refused.key"), other
        assert "key: it belongs to another request" in answer.json()["message"]
    taken = post_capture(rig, key="1" * 16, eye="OD")  # the key of the request that started a visit
    assert (taken.status_code, taken.json()["message"]) == (409, "key: it belongs to another request")
    assert post_capture(rig, **request_body).json()["id"] == kept.json()["id"]
    assert [capture.id for capture in rig.store.captures()] == [kept.json()["id"]]


def test_an_idempotency_key_is_bound_while_its_capture_is_in_progress(rig: Any) -> None:
    rig.block_exposures()
    first = rig.exam.press("OD", KEY)
    assert rig.exam.press("OD", KEY) is first
    answer = post_capture(rig, eye="OS")
    rig.clock.gate.set()
    assert (answer.status_code, answer.json()["message"]) == (409, "key: it belongs to another request")
    assert first.result(30).eye == "OD"


def test_a_moved_capture_keeps_its_idempotency_key(tmp_path: Any) -> None:
    clock = VirtualClock()
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        visit = people.answer("3" * 16, people.begin("1" * 16).id, "consent", "agreed").id
        keep(store, people, "c1", "OD", visit)
        people.pictures.correct_laterality("2" * 16, "c1", "OS", None)
        assert store.get("c1").eye == "OS"
        assert people.pictures.capture_for_key(KEY, "OD", visit, "R-centre") == "c1"
        assert people.pictures.capture_for_key(OTHER_KEY, "OD", visit, "R-centre") is None


def keep(store: CaptureStore, people: VisitRepository, id: str, eye: Eye, visit: str) -> None:
    target = people.pictures.capture_target(eye, KEY, visit, "R-centre")
    report = CaptureReport(visit=target.visit, slot=target.slot)
    taken = Capture(id, eye, people.clock.wall(), True, "00ff", report, {})
    store.save(taken, {"raw.tiff": b"raw"}, target.write_rows)


def test_an_interrupted_capture_ends_when_its_key_is_completed(tmp_path: Any) -> None:
    lost, other = InterruptedCapture("20260301T120000-OD-ab", "OD"), InterruptedCapture("20260301T120001-OS-cd", "OS")
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        before = CaptureJournal(store)
        before.begin(lost, KEY)
        before.begin(other, OTHER_KEY)
        again = CaptureJournal(store)
        assert again.interrupted == (lost, other)
        again.end("20260301T120002-OD-ef", KEY)
        assert again.interrupted == (other,)
        assert CaptureJournal(store).interrupted == (other,)


def test_the_status_reports_an_interrupted_test_picture_in_one_run_only(
    build: Callable[..., Rig], tmp_path: Path
) -> None:
    lost = InterruptedCapture("20260301T120000-OD-ab", "OD")
    with CaptureStore(tmp_path / "store", reserve_bytes=0) as store:
        CaptureJournal(store).begin(lost, KEY)
    reported = []
    for _ in range(3):
        with ExitStack() as undo:
            rig = build(tmp_path, undo)
            ids = [[capture["id"] for capture in rig.request("GET", "/api/status").json()["swept"]] for _ in range(2)]
            reported.append(ids)
    assert reported == [[[lost.id], [lost.id]], [[], []], [[], []]]
