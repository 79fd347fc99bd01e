"""Health checks against a real server over HTTP: healthy, faulty, unreachable and hanging."""

import json
import socket
from collections.abc import Callable
from typing import Any

from services.health.probe import probe_instrument
from tests.journey.asking import live_picture


def test_health_lists_every_check_and_a_fault_fails_its_check(old_rig: Any, wait_until: Callable[..., None]) -> None:
    old_rig.request("POST", "/api/captures", json={"eye": "OD"})
    well = old_rig.request("GET", "/api/health").json()
    assert {check["name"] for check in well["checks"]} == {
        "camera",
        "lamp",
        "calibration",
        "captures",
        "database",
        "space",
        "battery",
        "heat",
        "clock",
        "speed",
        "sending",
        "backup",
        "audit_log",
        "light_limits",
        "settings",
        "power",
    }
    times = well["times"]
    assert times["pictures"] == 1
    assert times["from_tap"]["p50_s"] > times["from_read_out"]["p50_s"] >= 0
    assert (times["late"]["p99_s"] > 0.05 * 5.0) == (times["missed"] == 1)
    old_rig.world.faults.add("camera.missing")
    live_picture(old_rig.exam, 0, wait_s=0.0)
    wait_until(lambda: old_rig.exam.problem is not None)
    ill = old_rig.request("GET", "/api/health").json()
    failed = [check for check in ill["checks"] if not check["ok"]]
    assert [(check["name"], check["remedy"]) for check in failed] == [("camera", old_rig.exam.problem.remedy)]
    old_rig.world.faults.clear()


def test_damaged_capture_fails_the_captures_check(rig: Any) -> None:
    capture = rig.request("POST", "/api/captures", json={"eye": "OD"}).json()
    path = rig.exam.store.folder / "captures" / capture["id"] / "raw.tiff"
    path.write_bytes(path.read_bytes()[:-1] + b"\x00\x01")
    checks = {check["name"]: check for check in rig.request("GET", "/api/health").json()["checks"]}
    assert not checks["captures"]["ok"]
    assert "raw.tiff" in checks["captures"]["value"]


def test_unreachable_or_hanging_server_fails_the_page_check() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        port = silent.getsockname()[1]
        refused = probe_instrument(f"http://127.0.0.1:{port}")
        silent.listen()
        hung = probe_instrument(f"http://127.0.0.1:{port}", timeout_s=0.3)
    for checks in (refused, hung):
        assert [(check.name, check.ok, check.of_release) for check in checks] == [("page", False, True)]


def test_health_command_exits_with_1_if_a_check_fails(diffuscope: Callable[..., Any]) -> None:
    done = diffuscope("health", "--at", "http://127.0.0.1:9", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)[0]["name"] == "page"
