"""Removal of exported pictures by the technician: what may be removed, what a reader gets, and the way back."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.delivery.usb_drives import UsbDrives
from services.http.app import create_app
from tests.journey.conftest import Rig, drive_id, technician_requests

KEYS = (f"{number:016x}" for number in count(1))


@pytest.fixture
def rig(build: Callable[..., Rig], tmp_path: Path, drives: UsbDrives) -> Iterator[Rig]:
    with ExitStack() as undo:
        rig = build(tmp_path, undo)
        rig.application = create_app(rig.arbiter, rig.authenticator, usb_drives=drives)
        yield rig


@pytest.fixture
def ask(rig: Rig) -> Callable[..., httpx.Response]:
    return technician_requests(rig, "/api/technician/removal")


def finished_visit(rig: Rig) -> tuple[str, str]:
    """Return the ids of a finished visit and of its capture."""
    visit = rig.request("POST", "/api/visits", json={"key": next(KEYS)}).json()["id"]
    at = f"/api/visits/{visit}"
    rig.request("PATCH", at, json={"key": next(KEYS), "field": "consent", "value": "agreed"})
    press = {"key": next(KEYS), "eye": "OD", "visit": visit, "slot": "R-centre"}
    capture = rig.request("POST", "/api/captures", json=press).json()["id"]
    assert rig.request("POST", f"{at}/finish", json={"key": next(KEYS)}).status_code == 200
    return visit, capture


def test_an_exported_visit_is_removed_and_brought_back(rig: Rig, ask: Callable[..., Any], stick: Path) -> None:
    visit, capture = finished_visit(rig)
    picture = f"/api/captures/{capture}/picture.png"
    before = rig.request("GET", picture).content
    assert ask("GET").json()["visits"] == 0
    copied = rig.request("POST", f"/api/visits/{visit}/export", json={"key": next(KEYS), "folder": drive_id(stick)})
    assert copied.status_code == 200
    may = ask("GET").json()
    assert (may["visits"], may["captures"], may["undoable_captures"]) == (1, 1, 0)
    assert may["oldest_day"] == may["newest_day"]
    done = ask("POST").json()
    assert (done["visits"], done["undoable_captures"], done["undoable_bytes"]) == (0, 1, may["size_bytes"])
    for name in ("picture.png", "colour.png", "raw-3.tiff", "raw-red.tiff"):
        gone = rig.request("GET", f"/api/captures/{capture}/{name}")
        assert (gone.status_code, gone.json()["code"]) == (410, "store.removed")
    assert rig.request("GET", f"/api/captures/{capture}/quick.jpg").status_code == 200
    checks = {check["name"]: check["ok"] for check in rig.request("GET", "/api/health").json()["checks"]}
    assert checks["captures"]
    assert rig.request("GET", f"/api/visits/{visit}").json()["slots"]["R-centre"]["capture"] == capture
    assert ask("POST", "/undo").json()["undoable_captures"] == 0
    assert rig.request("GET", picture).content == before
