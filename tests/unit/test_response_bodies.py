"""Response bodies: stored data of any release, absent keys, times and numbers as before."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from device.clock import VirtualClock
from device.errors import InputError, StoreError
from services.errors import StoreDamaged
from services.health.alerts import Alert
from services.http.problem_responses import problem_body, problem_response
from services.http.routes.visits import visit_answer
from services.http.schemas.captures import capture_answer
from services.http.schemas.status import AlertAnswer
from services.records.capture import Capture, CaptureReport
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.visit import SlotState, Visit
from services.records.visit_repository import VisitRepository

STORED: dict[str, Any] = {
    "method": "variation",
    "seconds": {"expose": 0.5, "solve": 2},
    "dose_24h_j_per_cm2": {"OD": 0.25, "OS": 0},
    "verdict": {"word": "good", "code": None, "numbers": {"lit": 1}, "sharpness": 3},
    "note": ["kept"],
}


def wire_text(report: dict[str, Any]) -> str:
    taken_at = datetime(2026, 3, 1, 9, 30, tzinfo=UTC)
    return capture_answer(Capture("c1", "OD", taken_at, True, "00ff", CaptureReport.read(report), {})).model_dump_json()


def on_the_wire(report: dict[str, Any]) -> Any:
    return json.loads(wire_text(report))["report"]


def test_entries_of_other_releases_are_passed_on() -> None:
    shown = on_the_wire(STORED)
    assert shown["note"] == ["kept"]
    assert shown["verdict"]["sharpness"] == 3
    assert {name: shown[name] for name in STORED} == STORED


def test_whole_numbers_stay_whole() -> None:
    assert '"dose_24h_j_per_cm2":{"OD":0.25,"OS":0}' in wire_text(STORED)


def test_an_entry_of_an_unknown_type_does_not_hide_the_capture() -> None:
    shown = on_the_wire(STORED | {"method": 5, "quality": "good", "moved": None})
    assert (shown["method"], shown["quality"], "moved" in shown) == ("none", {}, False)


def test_times_are_iso_8601_with_an_offset() -> None:
    assert json.loads(wire_text(STORED))["taken_at"] == "2026-03-01T09:30:00+00:00"


def test_values_that_are_not_known_have_no_key() -> None:
    assert AlertAnswer.model_validate(Alert("store.low", n=3)).model_dump() == {"code": "store.low", "n": 3}
    assert set(problem_body(InputError("no", "Stop.")).model_dump()) == {"code", "message", "remedy"}
    assert problem_body(InputError("no", "Stop.", wait_s=2.0)).model_dump()["wait_s"] == 2.0


def test_a_visit_with_an_impossible_answer_is_damaged(tmp_path: Path) -> None:
    slots = {slot.id: SlotState() for slot in load_programme().slots}
    visit = Visit("v1", "p1", "A1", "2026-03-01", datetime(2026, 3, 1, tzinfo=UTC), {"age": {"years": 1}}, slots)
    with CaptureStore(tmp_path, reserve_bytes=0) as store, pytest.raises(StoreDamaged, match="v1"):
        visit_answer(visit, VisitRepository(store.engine, load_programme(), VirtualClock()))


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        (
            "the disk refused: [Errno 28] No space left on device: '/data/store/captures/.a.part/b.json'",
            "the disk refused: [Errno 28] No space left on device: 'b.json'",
        ),
        ("/boot/chooser/diffuscope.toml, line 3: no", "diffuscope.toml, line 3: no"),
        ("'/media/me/USB STICK/a b.tiff' and /srv/x/y.npy", "'a b.tiff' and y.npy"),
        ("GET /api/nothing/x: Not Found", "GET /api/nothing/x: Not Found"),
        ("https://reader.org/inbox/a answers 5 / 6 of 1/2", "https://reader.org/inbox/a answers 5 / 6 of 1/2"),
    ],
)
def test_a_message_names_files_without_their_folders(message: str, shown: str) -> None:
    assert json.loads(problem_response(StoreError(message)).body)["message"] == shown
