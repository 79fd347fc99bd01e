"""The diary that is taken away: as a file, and onto a stick, by the technician only."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from services.instrument.api import create_app
from services.instrument.diary import Diary
from services.instrument.diary_api import diary_routes
from services.instrument.exporting import Sticks
from tests.journey.conftest import Rig
from tests.journey.test_export import mounted

log = logging.getLogger("services.instrument.nobody")


@pytest.fixture
def stick(tmp_path: Path) -> Path:
    folder = tmp_path / "media" / "USB STICK"
    folder.mkdir(parents=True)
    mounted(tmp_path / "mounts", folder)
    return folder


@pytest.fixture
def rig(build: Callable[..., Rig], tmp_path: Path, stick: Path) -> Iterator[Rig]:
    with ExitStack() as undo:
        rig = build(tmp_path, undo, wait=False)
        diary = Diary(tmp_path / "diary")
        undo.callback(diary.close)
        rooms = (diary_routes(diary, Sticks((tmp_path / "media",), tmp_path / "mounts"), rig.clock),)
        rig.app = create_app(rig.owner, rig.door, rooms=rooms)
        yield rig


@pytest.fixture
def ask(rig: Rig) -> Callable[..., Any]:
    """Requests from behind the door."""
    entered = rig.request("POST", "/api/technician/pin", json={"pin": "2580"})
    cookie = {"Cookie": entered.headers["set-cookie"].split(";")[0]}
    return lambda method, path, **more: rig.request(method, f"/api/technician/diary{path}", headers=cookie, **more)


def test_the_whole_diary_comes_as_a_file_of_sentences(ask: Callable[..., Any]) -> None:
    log.warning("press failed: %s", "the camera is gone", extra={"code": "camera.missing"})
    answer = ask("GET", ".txt")
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert 'filename="diary-' in answer.headers["content-disposition"]
    assert "WARNING: press failed: the camera is gone (camera.missing)" in answer.text


def test_it_goes_onto_a_stick_and_a_second_copy_leaves_the_first(ask: Callable[..., Any], stick: Path) -> None:
    log.info("a picture was kept")
    first, second = (ask("POST", "/export", json={"folder": str(stick)}).json()["folder"] for _ in range(2))
    assert second == f"{first}-2"
    assert "a picture was kept" in (stick / first / "diary.txt").read_text()
    lines = (stick / second / "diary.jsonl").read_text().splitlines()
    assert "a picture was kept" in [json.loads(line)["text"] for line in lines]


def test_it_goes_nowhere_but_onto_a_stick_that_is_there_and_to_nobody_outside(
    ask: Callable[..., Any], rig: Rig, tmp_path: Path
) -> None:
    refused = ask("POST", "/export", json={"folder": str(tmp_path)})
    assert (refused.status_code, refused.json()["code"]) == (503, "stick.gone")
    for method, path in (("GET", "/diary"), ("GET", "/diary.txt"), ("POST", "/diary/export")):
        away = {"json": {"folder": str(tmp_path)}} if method == "POST" else {}
        assert rig.request(method, f"/api/technician{path}", **away).json()["code"] == "technician.locked"
