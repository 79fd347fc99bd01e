"""Correction of the eye of a capture, and the order of finish, press and light cut."""

import asyncio
import io
import json
import zipfile
from itertools import count
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from device.errors import LightCut
from services.imaging.picture_files import to_png, with_note
from tests.journey.asking import visit_with_consent

keys = (f"{number:016x}" for number in count(1))


def post(rig: Any, path: str, **body: Any) -> Any:
    answer = rig.request("POST", path, json={"key": next(keys), **body})
    assert answer.status_code in (200, 201), answer.text
    return answer.json()


def shoot(rig: Any, visit: str, slot: str) -> str:
    eye = "OD" if slot.startswith("R") else "OS"
    return str(post(rig, "/api/captures", eye=eye, visit=visit, slot=slot)["id"])


def test_a_finish_waits_for_the_capture_in_progress(make_rig: Any) -> None:
    rig = make_rig()
    visit = visit_with_consent(rig)["id"]
    shoot(rig, visit, "R-centre")
    press = {"key": next(keys), "eye": "OS", "visit": visit, "slot": "L-centre"}

    async def requests(client: httpx.AsyncClient) -> tuple[httpx.Response, httpx.Response]:
        rig.block_exposures()
        pressed = asyncio.create_task(client.post("/api/captures", json=press))
        while rig.exam.state != "busy":
            await asyncio.sleep(0.01)
        ended = asyncio.create_task(client.post(f"/api/visits/{visit}/finish", json={"key": next(keys)}))
        done, _ = await asyncio.wait([ended], timeout=0.5)
        assert not done, "finished while a capture was in progress"
        rig.clock.gate.set()
        return await pressed, await ended

    made, ended = rig.ask(requests)
    assert made.status_code == 201
    assert ended.json()["outcome"]["code"] == "send"
    assert ended.json()["slots"]["L-centre"]["capture"] == made.json()["id"]


def test_a_light_cut_has_its_own_error_and_does_not_block_a_finish(make_rig: Any, wait_until: Any) -> None:
    rig = make_rig(max_on_s=0.15)
    visit = visit_with_consent(rig)["id"]
    press = {"key": next(keys), "eye": "OD", "visit": visit, "slot": "R-centre"}

    async def requests(client: httpx.AsyncClient) -> tuple[httpx.Response, httpx.Response]:
        rig.block_exposures()
        pressed = asyncio.create_task(client.post("/api/captures", json=press))
        await asyncio.to_thread(wait_until, lambda: rig.world.illumination is not None)
        await asyncio.to_thread(wait_until, lambda: rig.world.illumination is None)
        ended = asyncio.create_task(client.post(f"/api/visits/{visit}/finish", json={"key": next(keys)}))
        rig.clock.gate.set()
        return await pressed, await ended

    failed, ended = rig.ask(requests)
    assert (failed.status_code, failed.json()["code"]) == (423, LightCut.code)  # not the dose limit
    assert "Take it again" in failed.json()["remedy"]
    assert ended.json()["outcome"]["code"] == "refer_picture"


def test_a_message_about_a_finished_visit_has_neither_number_nor_id(rig: Any) -> None:
    """The event log keeps messages, and no identifying value."""
    visit = post(rig, "/api/visits")
    post(rig, f"/api/visits/{visit['id']}/finish")
    press = {"key": next(keys), "eye": "OD", "visit": visit["id"], "slot": "R-centre"}
    rig.clock.elapsed_s += 2 * 86400
    for path, body in (
        ("/api/captures", press),
        (f"/api/visits/{visit['id']}/not-possible", {"key": next(keys), "slot": "R-centre", "reason": "lids"}),
        (f"/api/visits/{visit['id']}/reopen", {"key": next(keys), "reason": "picture"}),
    ):
        answer = rig.request("POST", path, json=body)
        assert answer.status_code == 409
        assert "finished" in answer.json()["message"]
        assert visit["number"] not in answer.text
        assert visit["id"] not in answer.text


@pytest.mark.parametrize("reason", ["lids", "other"])
def test_a_slot_marked_as_not_possible_can_be_taken_later(rig: Any, reason: str) -> None:
    visit = visit_with_consent(rig)["id"]
    crossed = post(rig, f"/api/visits/{visit}/not-possible", slot="R-nerve", reason=reason)
    assert crossed["slots"]["R-nerve"]["state"] == "not_possible"
    back = post(rig, f"/api/visits/{visit}/slots", slot="R-nerve", capture=None)
    assert back["slots"]["R-nerve"]["state"] == "empty"
    post(rig, f"/api/visits/{visit}/not-possible", slot="R-nerve", reason=reason)
    taken = shoot(rig, visit, "R-nerve")
    slot = rig.request("GET", f"/api/visits/{visit}").json()["slots"]["R-nerve"]
    assert (slot["state"], slot["capture"]) == ("taken", taken)


def test_a_capture_of_the_other_eye_is_moved_and_the_move_is_recorded(rig: Any) -> None:
    visit = visit_with_consent(rig)["id"]
    first, wrong = shoot(rig, visit, "R-centre"), shoot(rig, visit, "R-centre")
    before = rig.request("GET", f"/api/captures/{wrong}").json()
    headers, order = {"X-Controller": "b" * 16}, {"key": next(keys), "eye": "OS"}
    moved = rig.request("POST", f"/api/captures/{wrong}/eye", json=order, headers=headers).json()
    assert moved["slots"]["R-centre"] | {"verdict": None} == {
        "state": "taken",
        "capture": first,
        "captures": [first],
        "verdict": None,
        "reason": None,
        "tries": 1,
    }
    assert moved["slots"]["L-centre"]["capture"] == wrong
    now = rig.request("GET", f"/api/captures/{wrong}").json()
    assert (now["eye"], now["slot"], now["files"]) == ("OS", "L-centre", before["files"])
    (correction,) = now["report"]["moved"]
    assert (correction["from_eye"], correction["from_slot"], correction["eye"]) == ("OD", "R-centre", "OS")
    assert correction["at"] == rig.clock.wall().isoformat()
    assert correction["by"] == rig.request("GET", "/api/status").json()["controller"]
    again = rig.request("POST", f"/api/captures/{wrong}/eye", json=order, headers=headers).json()
    once_more = rig.request("POST", f"/api/captures/{wrong}/eye", json=order | {"key": next(keys)}, headers=headers)
    assert again["slots"] == once_more.json()["slots"] == moved["slots"]
    assert len(rig.request("GET", f"/api/captures/{wrong}").json()["report"]["moved"]) == 1
    rig.request("POST", f"/api/captures/{first}/eye", json={"key": next(keys), "eye": "OS"}, headers=headers)
    last = rig.request("GET", f"/api/visits/{visit}").json()
    assert last["slots"]["R-centre"]["state"] == "empty"
    assert last["next_slot"] == "R-centre"
    assert last["slots"]["L-centre"]["captures"] == [first, wrong]


def test_moving_a_chosen_capture_empties_its_old_slot(rig: Any) -> None:
    visit = visit_with_consent(rig)["id"]
    wrong = shoot(rig, visit, "R-centre")
    post(rig, f"/api/captures/{wrong}/accept")
    moved = post(rig, f"/api/captures/{wrong}/eye", eye="OS")
    assert moved["slots"]["R-centre"]["state"] == "empty"
    post(rig, f"/api/visits/{visit}/finish")
    for id, status in ((wrong, 409), ("unknown", 404)):
        answer = rig.request("POST", f"/api/captures/{id}/eye", json={"key": next(keys), "eye": "OD"})
        assert answer.status_code == status
    assert rig.request("GET", f"/api/captures/{wrong}").json()["eye"] == "OS"


def test_the_export_follows_the_move(rig: Any) -> None:
    visit = visit_with_consent(rig)["id"]
    wrong = shoot(rig, visit, "R-nerve")
    post(rig, f"/api/captures/{wrong}/eye", eye="OS")
    answer = rig.request("GET", f"/api/visits/{visit}/export.zip")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        files = {name.split("/")[1]: archive.read(name) for name in archive.namelist()}
    assert set(files) == {
        "L-nerve-1.png",
        "L-nerve-1-colour.png",
        "L-nerve-1.json",
        "visit.json",
        "history.json",
        "SHA256SUMS",
    }
    report = json.loads(files["L-nerve-1.json"])
    assert (report["eye"], report["slot"], report["moved"][0]["from_eye"]) == ("OS", "L-nerve", "OD")
    for name, of in (("L-nerve-1.png", "picture.png"), ("L-nerve-1-colour.png", "colour.png")):
        kept = Image.open(io.BytesIO(rig.store.read(wrong, of)))
        with Image.open(io.BytesIO(files[name])) as shown:
            assert str(shown.info["note"]).startswith("OS ")
            assert shown.info.get("predicted") == kept.info.get("predicted")
            assert np.array_equal(np.asarray(shown), np.asarray(kept))


def test_a_changed_note_changes_no_pixel_and_no_mark() -> None:
    png = to_png(np.linspace(0, 1, 10000, dtype=np.float32).reshape(100, 100), True, "OD 2026-11-21")
    assert with_note(with_note(png, "OS 2026-11-21"), "OD 2026-11-21") == png
