"""`diffuscope health` against a real server over real HTTP: well, not there, and a server that says nothing."""

import json
import socket
from collections.abc import Callable
from typing import Any

from services.health.probe import examine


def test_health_lists_every_check_and_driven_faults_fail_them(old_rig: Any, wait_until: Callable[..., None]) -> None:
    old_rig.request("POST", "/api/captures", json={"eye": "OD"})
    well = old_rig.request("GET", "/api/health").json()
    assert {check["name"] for check in well["checks"]} == {
        "camera", "lamp", "calibration", "captures", "space", "battery", "heat", "clock", "speed", "sending",
    }  # fmt: skip
    old_rig.world.faults.add("camera.missing")
    old_rig.exam.preview(0, wait_s=0.0)
    wait_until(lambda: old_rig.exam.problem is not None)
    ill = old_rig.request("GET", "/api/health").json()
    failed = [check for check in ill["checks"] if not check["ok"]]
    assert [(check["name"], check["remedy"]) for check in failed] == [("camera", old_rig.exam.problem.remedy)]
    old_rig.world.faults.clear()


def test_a_damaged_capture_is_found(rig: Any) -> None:
    kept = rig.request("POST", "/api/captures", json={"eye": "OD"}).json()
    path = rig.exam.store.folder / "captures" / kept["id"] / "raw.tiff"
    path.write_bytes(path.read_bytes()[:-1] + b"\x00\x01")
    checks = {check["name"]: check for check in rig.request("GET", "/api/health").json()["checks"]}
    assert not checks["captures"]["ok"]
    assert "SHA-256" in checks["captures"]["value"]


def test_a_server_that_is_not_there_or_says_nothing_fails_one_check() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        port = silent.getsockname()[1]
        refused = examine(f"http://127.0.0.1:{port}")
        silent.listen()
        hung = examine(f"http://127.0.0.1:{port}", patience_s=0.3)
    for checks in (refused, hung):
        assert [(check.name, check.ok, check.of_release) for check in checks] == [("page", False, True)]


def test_the_command_prints_and_exits_by_what_it_found(diffuscope: Callable[..., Any]) -> None:
    done = diffuscope("health", "--at", "http://127.0.0.1:9", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)[0]["name"] == "page"
