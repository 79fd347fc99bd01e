"""Fault scenarios: for each state of the page, the simulated fault of head, disk or clock that causes it.

A scenario injects a fault into a `Rig` and returns the response of the real server as an `Observation`: code, the
numbers that the text of the page needs, and the remedy of a refusal.
"""

import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from device.sim.world import World
from device.values import BatteryState
from services.delivery.upload_worker import UploadWorker
from services.http.control_lease import LEASE_S
from tests.journey.asking import (
    MAKE_WEEKS,
    MAX_BYTES,
    DiskStub,
    Observation,
    PressHookBus,
    active_alert,
    next_preview,
    post_capture,
    record_answer,
    status_problem,
    visit_with_consent,
)
from tests.journey.conftest import Rig, until
from tests.simulated import with_keys

WEEKS = 30  # age of the expired calibration
VISIT = {"key": "0" * 16}


@contextmanager
def simulated_light(rig: Rig, times: float = 1.0, **keys: Any) -> Iterator[None]:
    """Replace the simulated illumination within the context: `times` as much light, other keys of [sim]."""
    spec = rig.world.spec
    other = World(with_keys(spec, peak_e=spec.sim.peak_e * times, **keys), rig.clock)  # type: ignore[union-attr]  # a simulated head has [sim]
    for colour in ("green", "red"):
        other.electrons_per_s(colour)
    own, rig.world.eyes = rig.world.eyes, other.eyes
    yield
    rig.world.eyes = own


def capture_of(times: float = 1.0, **keys: Any) -> Callable[[Rig, DiskStub], Observation]:
    def scenario(rig: Rig, disk: DiskStub) -> Observation:
        with simulated_light(rig, times, **keys):
            return post_capture(rig)

    return scenario


def with_fault(name: str, ask: Callable[[Rig], Observation]) -> Callable[[Rig, DiskStub], Observation]:
    def scenario(rig: Rig, disk: DiskStub) -> Observation:
        rig.world.faults.add(name)
        return ask(rig)

    return scenario


def no_eye(rig: Rig, disk: DiskStub) -> Observation:
    wait_until_idle(rig)
    rig.clock.sleep(60)
    rig.world.faults.add("eye.closed")
    return post_capture(rig)


def blink(rig: Rig, disk: DiskStub) -> Observation:
    next_preview(rig, next_preview(rig, 0))
    assert isinstance(rig.event_bus, PressHookBus)
    rig.event_bus.on_press = lambda: rig.world.faults.add("eye.closed")
    return post_capture(rig)


def spend_dose(rig: Rig, ago_s: float) -> None:
    """Charge 99.9 % of the daily dose limit left to the right eye, `ago_s` seconds ago; one more capture exceeds it."""
    light = rig.exam.head.light
    left = light.hazard.limits.stop_j_per_cm2 - light.ledger.spent_j_per_cm2("OD")
    light.ledger.reserve(("OD",), 0.999 * left, light.hazard.limits.stop_j_per_cm2)
    rig.clock.sleep(ago_s)


def light_limit(rig: Rig, disk: DiskStub) -> Observation:
    spend_dose(rig, 22.5 * 3600)
    observed = post_capture(rig)
    assert 0 < observed.facts["n"] <= 180
    assert post_capture(rig, "OS").way == "verdict", "the other eye can go on"
    next_preview(rig, 0, "OS")
    wait_until_idle(rig)  # an exposure reserves its maximum dose first, and settles the actual dose later
    ledger = rig.exam.head.light.ledger
    before = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    next_preview(rig, rig.exam.snapshot.output.preview.number, "OS")
    wait_until_idle(rig)
    assert ledger.spent_j_per_cm2("OD") == before[0], "aiming at one eye costs the other nothing"
    assert ledger.spent_j_per_cm2("OS") > before[1]
    rig.clock.sleep(60 * observed.facts["n"])
    assert post_capture(rig).way == "verdict", "after its rest the eye gets light again"
    return observed


def light_day(rig: Rig, disk: DiskStub) -> Observation:
    spend_dose(rig, 0.0)
    observed = post_capture(rig)
    assert post_capture(rig, "OS").way == "verdict", "the other eye can go on"
    rig.clock.sleep(25 * 3600)
    return observed


def at_temperature(celsius: float, code: str) -> Callable[[Rig, DiskStub], Observation]:
    def scenario(rig: Rig, disk: DiskStub) -> Observation:
        rig.world.temperature_c = celsius
        observed = active_alert(rig, code)
        if code == "heat.hot":
            assert observed.facts == {"wait_s": 300}
            rig.clock.sleep(48)
            standing = rig.request("GET", "/api/status").json()["standing"]
            assert {"code": code, "wait_s": 252} in standing
            refused = post_capture(rig)
            assert (refused.way, refused.code) == ("423", "head.hot")
            return replace(observed, remedy=refused.remedy)
        assert post_capture(rig).way == "verdict"
        return observed

    return scenario


def at_charge(fraction: float, code: str) -> Callable[[Rig, DiskStub], Observation]:
    def scenario(rig: Rig, disk: DiskStub) -> Observation:
        rig.world.battery_state = BatteryState(fraction, 3.5)
        observed = active_alert(rig, code)
        if code == "batt.empty":
            refused = post_capture(rig)
            assert (refused.way, refused.code) == ("423", "power.low")
            return replace(observed, remedy=refused.remedy)
        assert post_capture(rig).way == "verdict"
        return observed

    return scenario


def store_full(rig: Rig, disk: DiskStub) -> Observation:
    stored = rig.request("GET", "/api/captures").json()
    disk.free_bytes = 0
    observed = active_alert(rig, "store.full")
    refused = post_capture(rig)
    assert (refused.way, refused.code) == ("507", "store.full")
    assert rig.request("GET", "/api/captures").json() == stored, "no stored capture is lost"
    disk.free_bytes = MAX_BYTES
    rig.application.alerts.publish_changes()
    assert rig.published_events()[-1] == ("notice", {"code": "store.full", "over": True})
    assert post_capture(rig).way == "verdict", "captures work again with free space"
    return replace(observed, remedy=refused.remedy)


def store_low(rig: Rig, disk: DiskStub) -> Observation:
    disk.free_bytes = (
        5 * 4 * 10_000_000
        if not rig.store.captures(1)
        else 40
        * sum(path.stat().st_size for path in (rig.store.folder / "captures" / rig.store.captures(1)[0].id).iterdir())
    )
    return active_alert(rig, "store.low")


def slow_capture(rig: Rig, disk: DiskStub) -> Observation:
    """Delay the disk by ten seconds during a capture; the alert is active meanwhile."""
    observations: list[Observation] = []

    def delay_once() -> None:
        if rig.exam.state == "making" and not observations:
            disk.on_query = lambda: None
            rig.clock.sleep(10)
            observations.append(active_alert(rig, "make.slow"))

    disk.on_query = delay_once
    assert post_capture(rig).way == "verdict"
    return observations[0]


def failed_reconstruction(rig: Rig, disk: DiskStub) -> Observation:
    rig.world.faults.add("camera.mode")
    observed = post_capture(rig)
    assert observed.facts["method"] == "none"
    return observed


def poor_after_retakes(rig: Rig, disk: DiskStub) -> Observation:
    visit = visit_with_consent(rig, "b" * 16)["id"]
    with simulated_light(rig, 0.003):
        codes = [post_capture(rig, visit=visit, slot="R-centre").code for _ in range(3)]
    assert codes[:2] == ["shot.dark"] * 2
    return Observation("verdict", codes[2], {"n": 3})


def other_screen(rig: Rig, disk: DiskStub) -> Observation:
    ours, theirs = "1" * 16, "2" * 16
    assert rig.request("POST", "/api/controller", json={"key": theirs}).json()["mine"]
    answer = rig.request("POST", "/api/captures", json={"eye": "OD"}, headers={"X-Controller": ours})
    rig.request("POST", "/api/controller", json={"key": theirs, "release": True})
    rig.clock.sleep(3)
    assert rig.request("POST", "/api/controller", json={"key": ours}).json()["mine"], "a closed page releases its lease"
    return Observation(str(answer.status_code), answer.json()["code"], {}, answer.json()["remedy"])


def without_consent(value: str | None) -> Callable[[Rig, DiskStub], Observation]:
    """Withdraw the consent after the first capture of a visit: the next press is refused without light."""

    def scenario(rig: Rig, disk: DiskStub) -> Observation:
        visit = visit_with_consent(rig)["id"]
        assert post_capture(rig, visit=visit, slot="R-centre").way == "verdict"
        record_answer(rig, visit, "consent", value)
        frames = rig.world.frames
        observed = post_capture(rig, visit=visit, slot="R-nerve")
        assert (observed.way, rig.world.frames) == ("409", frames)
        return observed

    return scenario


def no_date(rig: Rig, disk: DiskStub) -> Observation:
    """A device without network and clock cell, where the unit that sets the clock takes requests."""
    folder = rig.store.folder.parent / "system/run/diffuscope-clock"
    folder.mkdir(parents=True)
    try:
        return active_alert(rig, "clock.unset")
    finally:
        folder.rmdir()


def wrong_date(rig: Rig, disk: DiskStub) -> Observation:
    rig.clock.start -= timedelta(days=365 * 6)
    return active_alert(rig, "clock.wrong")


def other_eye(rig: Rig, disk: DiskStub) -> Observation:
    rig.world.faults.add("eye.other")
    visit = visit_with_consent(rig)["id"]
    assert post_capture(rig, visit=visit, slot="R-centre").code == "good"
    return active_alert(rig, "eye.side")


def old_calibration(rig: Rig, disk: DiskStub) -> Observation:
    rig.clock.sleep((WEEKS - MAKE_WEEKS) * 7 * 86400.0)
    observed = active_alert(rig, "cal.old")
    assert observed.facts["n"] >= WEEKS
    assert post_capture(rig).way == "verdict"
    return observed


def power_cut(rig: Rig, again: Callable[[], Rig], folder: Path) -> Observation:
    """Cut the power during the second capture of a visit: open a copy of the store made at that moment."""
    visit = visit_with_consent(rig, "c" * 16)["id"]
    assert post_capture(rig, visit=visit, slot="R-centre").way == "verdict"
    rig.block_exposures()
    target = {"eye": "OS", "visit": visit, "slot": "L-nerve"}
    answer = rig.exam.press("OS", None, people(rig).pictures.capture_target("OS", None, visit, "L-nerve"))
    rig.wait_for_blocked_exposure()
    shutil.copytree(rig.store.folder, folder / "store")
    rig.clock.gate.set()
    answer.result(30)
    started = again()
    lost = started.request("GET", "/api/status").json()["swept"]
    assert len(lost) == 1
    assert target.items() <= lost[0].items()
    assert post_capture(started, "OS", visit=visit, slot="L-nerve").way == "verdict"
    assert started.request("GET", "/api/status").json()["swept"] == [], "a repeated capture clears it"
    return Observation("status", "power.lost", {"eye": lost[0]["eye"], "slot": lost[0]["slot"]})


def fail_upload(rig: Rig, disk: DiskStub, answers: dict[str, int]) -> dict[str, Any]:
    """Finish a visit while the receiver answers with errors; return its entry in the upload queue."""
    worker = upload_worker(rig)
    number = worker.queue.status().waiting + len(disk.receiver.kept)
    key = f"{number + 256:016x}"
    visit = visit_with_consent(rig, key)["id"]
    assert post_capture(rig, visit=visit, slot="R-centre").way == "verdict"
    rig.request("POST", f"/api/visits/{visit}/finish", json={"key": key[::-1]})
    disk.receiver.answers = answers
    upload_pending(rig)
    listed = rig.request("GET", "/api/upload-queue").json()
    assert (listed["configured"], listed["waiting"]) == (True, len(listed["visits"]))
    assert rig.request("GET", "/api/status").json()["sending"]["waiting"] == listed["waiting"]
    entry: dict[str, Any] = next(queued for queued in listed["visits"] if queued["visit"] == visit)
    assert entry["size_bytes"] > 1000
    return entry


def upload_worker(rig: Rig) -> UploadWorker:
    """Return the upload worker of an instrument that has a receiver."""
    assert rig.application.upload_worker is not None
    return rig.application.upload_worker


def upload_pending(rig: Rig) -> None:
    """Run the upload worker until it has nothing to do, once the instrument is idle."""
    wait_until_idle(rig)
    rig.clock.sleep(6)
    until(lambda: rig.arbiter.is_idle, 120)
    while upload_worker(rig).step():
        pass


def assert_resolved(rig: Rig, code: str) -> None:
    """Assert that the alert is inactive and that its end was published."""
    rig.application.alerts.publish_changes()
    assert code not in {alert["code"] for alert in rig.request("GET", "/api/status").json()["standing"]}
    assert [data for _, data in rig.published_events() if data.get("code") == code][-1] == {"code": code, "over": True}


def upload_waiting(rig: Rig, disk: DiskStub) -> Observation:
    entry = fail_upload(rig, disk, {"HEAD": 503})
    assert (entry["tries"], entry["stuck"], entry["error"]["code"]) == (1, False, "send.link")
    assert "503" in entry["error"]["message"]
    observed = active_alert(rig, "send.waiting")
    assert post_capture(rig).way == "verdict", "captures do not wait for the network"
    disk.receiver.answers = {}
    rig.clock.sleep(60)
    upload_pending(rig)
    assert_resolved(rig, "send.waiting")
    return observed


def upload_stuck(rig: Rig, disk: DiskStub) -> Observation:
    before = len(disk.receiver.kept)
    entry = fail_upload(rig, disk, {"PUT": 403})
    assert (entry["stuck"], entry["error"]["code"]) == (True, "send.key")
    assert len(entry["error"]["remedy"]) > 20
    observed = active_alert(rig, "send.stuck")
    assert post_capture(rig).way == "verdict"
    disk.receiver.answers = {}
    assert rig.request("POST", "/api/upload-queue/retry", json={"key": "f" * 16}).json()["next_try_s"] == 0
    upload_pending(rig)
    assert_resolved(rig, "send.stuck")
    assert len(disk.receiver.kept) == before + 1
    return observed


def people(rig: Rig) -> Any:
    return rig.application.visits


EYE = {"eye": {}}
SCENARIOS: dict[str, Callable[[Rig, DiskStub], Observation]] = {
    "camera.missing": with_fault("camera.missing", post_capture),
    "camera.stalled": with_fault("camera.stalled", status_problem),
    "light.fault": with_fault("light.fault", post_capture),
    "light.limit": light_limit,
    "light.day": light_day,
    "cal.old": old_calibration,
    "shot.saturated": capture_of(6.0),
    "shot.dark": capture_of(0.003),
    "shot.pupil": capture_of(eye={"pupil_um": 1500.0}),
    "shot.moved": capture_of(eye={"drift_deg_per_s": 20.0}),
    "shot.blink": blink,
    "shot.noeye": no_eye,
    "shot.edge": capture_of(eye={"pupil_um": 4000.0, "decentred_um": 2500.0}),
    "shot.halo": capture_of(light={"polariser_leak": 0.1, "ring_um": 3500.0}),
    "shot.poor": poor_after_retakes,
    "make.slow": slow_capture,
    "make.failed": failed_reconstruction,
    "store.low": store_low,
    "store.full": store_full,
    "batt.low": at_charge(0.12, "batt.low"),
    "batt.empty": at_charge(0.03, "batt.empty"),
    "heat.warm": at_temperature(52.0, "heat.warm"),
    "heat.hot": at_temperature(61.0, "heat.hot"),
    "link.other": other_screen,
    "consent.missing": without_consent(None),
    "consent.declined": without_consent("declined"),
    "send.waiting": upload_waiting,
    "send.stuck": upload_stuck,
    "clock.unset": no_date,
    "clock.wrong": wrong_date,
    "eye.side": other_eye,
}
# Scenarios that need an instrument of their own: see test_fault_states.py.
SEPARATE = frozenset({"cal.missing", "cal.mismatch", "power.lost"})
# States that only the page can detect: file and name of their browser test.
OF_THE_PAGE = {
    "link.lost": ("test_page.py", "test_frozen_server_alert_begins_within_5_s_and_ends_within_3_s"),
    "link.slow": ("test_page_states.py", "test_old_live_frame_shows_its_age"),
    "light.cut": ("test_capture_edge_cases.py", "test_light_cut_returns_to_the_same_slot"),
    "shot.lost": ("test_capture_edge_cases.py", "test_lost_picture_is_reported_until_retaken"),
    "shot.crossed": ("test_capture_edge_cases.py", "test_not_possible_is_set_and_undone_while_aiming"),
    "shot.next": ("test_one_button.py", "test_going_on_is_announced_and_undone"),
}


def page_code(web: Path, code: str) -> str:
    """Return the name of the page for the server's `code` (web/core/alerts.js)."""
    table = (web / "core/alerts.js").read_text().split("const SAME = {")[1].split("};")[0]
    same = dict(re.findall(r'"([\w.]+)": "([\w.]+)"', table))
    return same.get(code, code)


def wait_until_idle(rig: Rig) -> None:
    """Wait until the exam takes no more live pictures and the lamp is off; virtual time may jump afterwards."""
    live_until_s = rig.exam.snapshot.live_until_s
    until(lambda: rig.clock.now_s() >= live_until_s and rig.world.illumination is None and rig.exam.state == "aim", 120)


def repair(rig: Rig) -> None:
    """Clear all faults and the state that a scenario has left."""
    world = rig.world
    world.faults.clear()
    world.temperature_c, world.battery_state = 25.0, BatteryState(0.775, 3.88)
    rig.clock.elapsed_s += LEASE_S  # no screen holds the camera any more
    wait_until_idle(rig)
    until(lambda: not rig.exam.calibration_monitor.has_pending, 120)
    for alert in rig.request("GET", "/api/status").json()["standing"]:
        if alert["code"] == "eye.side":  # an open question would affect the next scenario
            rig.request("POST", f"/api/captures/{alert['id']}/eye", json={"key": secrets.token_hex(8), "eye": "OD"})
