"""Each state of the page is reached by a simulated fault over the real server, with the numbers of its text."""

import json
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from device.calibration.archive import Archive
from device.config.head_file import CalibrationTable, load_head
from device.head import Head, open_bench, open_head, refuse_mismatched_head
from device.light_safety.dose_ledger import MemoryLedger
from device.ports import Chips
from device.sim.chips import SimHeadMemory
from device.values import BatteryState, HeadIdentity
from services.delivery.uploader import HttpsUploader, UploadSettings
from services.http.app import create_app
from services.http.control_lease import LEASE_S
from services.instrument.exam import ExamService
from services.instrument.head_arbiter import HeadArbiter
from tests.journey import asking, faults
from tests.journey.asking import DiskStub, Observation, PressHookBus
from tests.journey.conftest import GateClock, MakeRig, Rig, rig_builder, traced_world, until
from tests.receiver import receiving
from tests.simulated import SCENES, coarse
from tests.site import identity

K = 4  # binning of the paper's sensor, K x K pixels
WEB = Path(__file__).parents[2] / "web"
ALERTS = (WEB / "core/alerts.js").read_text()
STATES = re.findall(r'"(\w+\.\w+)"', ALERTS.split("const TABLE = [")[1].split("\n];")[0])
ENGLISH: dict[str, str] = json.loads((WEB / "i18n/en.json").read_text())
WORDS = {key.removeprefix("state.").removesuffix("_other"): words for key, words in ENGLISH.items()}
REFUSALS = {
    "camera.missing",
    "light.fault",
    "light.limit",
    "light.day",
    "store.full",
    "batt.empty",
    "heat.hot",
    "link.other",
    "consent.missing",
    "consent.declined",
}


@pytest.fixture(scope="module")
def equipped(plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, DiskStub]]:
    """A rig with thermometer, battery and dated calibration, shared by all scenarios."""
    clock, build = GateClock(), rig_builder(traced_world(coarse(load_head(SCENES / "calm.toml"), K)), plans)
    with ExitStack() as undo:
        folder = tmp_path_factory.mktemp("faults")
        certificate = identity(folder)
        disk = DiskStub(receiver=undo.enter_context(receiving(*certificate)))
        way = HttpsUploader(UploadSettings.model_validate(disk.receiver.settings(folder, authority=certificate[0])))
        made = {
            "head": asking.with_all_chips,
            "store": {"free_bytes": disk},
            "clock": clock,
            "event_bus": PressHookBus(),
        }
        yield build(folder, undo, **made, carrier=way), disk


@pytest.fixture
def rig(equipped: tuple[Rig, DiskStub]) -> Iterator[Rig]:
    rig, disk = equipped
    began = rig.clock.start
    rig.application.alerts.publish_changes()
    yield rig
    faults.repair(rig)
    disk.free_bytes, disk.on_query, rig.clock.start = asking.MAX_BYTES, lambda: None, began
    rig.application.alerts.publish_changes()


def assert_text_is_complete(code: str, observed: Observation) -> None:
    """Assert that the response has every number which the text of the page needs, and a refusal a remedy."""
    assert faults.page_code(WEB, observed.code) == code
    sent = {"part": "slot", "count": "n"}  # the server's names of what the page puts into a text
    own = {"today", "now"}  # of the page
    needed = {sent.get(name, name) for name in re.findall(r"\{\{(\w+)\}\}", WORDS[code])} - own
    assert needed <= observed.facts.keys()
    if code in REFUSALS:
        assert len(observed.remedy) > 20


@pytest.mark.parametrize("code", faults.SCENARIOS)
def test_a_fault_brings_its_state_about(code: str, rig: Rig, equipped: tuple[Rig, DiskStub]) -> None:
    assert_text_is_complete(code, faults.SCENARIOS[code](rig, equipped[1]))


@pytest.mark.parametrize(
    ("above_c", "charge", "refused", "active"),
    [
        (-0.01, 0.06, None, {"heat.warm", "batt.low"}),
        (0.0, 0.05, None, {"heat.warm", "batt.low"}),
        (0.01, 0.05, "head.hot", {"heat.hot", "batt.low"}),
        (0.0, 0.0499, "power.low", {"heat.warm", "batt.empty"}),
    ],
)
def test_capture_check_and_alert_agree_at_a_limit(
    rig: Rig, above_c: float, charge: float, refused: str | None, active: set[str]
) -> None:
    """A head at its temperature limit and a battery at its least charge still take pictures."""
    rig.world.temperature_c, rig.world.battery_state = asking.BUS.warmest_c + above_c, BatteryState(charge, 3.5)
    observed = asking.post_capture(rig)
    assert (observed.code if refused else observed.way) == (refused or "verdict")
    failed = {check["name"] for check in rig.request("GET", "/api/health").json()["checks"] if not check["ok"]}
    assert failed & {"heat", "battery"} == {"head.hot": {"heat"}, "power.low": {"battery"}}.get(refused or "", set())
    standing = {alert["code"] for alert in rig.request("GET", "/api/status").json()["standing"]}
    assert {code for code in standing if code.startswith(("heat.", "batt."))} == active


def test_every_state_of_the_page_has_its_scenario() -> None:
    assert len(STATES) == len(set(STATES)) >= 33
    reached = faults.SCENARIOS.keys() | faults.SEPARATE
    assert reached | faults.OF_THE_PAGE.keys() == set(STATES)
    assert len(reached) + len(faults.OF_THE_PAGE) == len(STATES)
    for file, test in faults.OF_THE_PAGE.values():
        assert f"def {test}(" in (WEB.parent / "tests" / "browser" / file).read_text()


def problem_without_calibration(rig: Rig, open_exam: Callable[[], ExamService]) -> Any:
    """Return the problem in the status of an instrument whose exam cannot be opened."""
    context = replace(rig.arbiter.context, archive=Archive(rig.store.folder / "nothing"))
    owner = HeadArbiter(context, open_exam, lambda: open_bench(rig.world.spec, rig.clock))
    try:
        build = partial(create_app, owner, rig.authenticator)
        return replace(rig, arbiter=owner, build_application=build).request("GET", "/api/status").json()["problem"]
    finally:
        owner.stop_calibration()
        owner.close()


def test_a_head_that_was_never_calibrated_is_cal_missing(make_rig: MakeRig, tmp_path: Path) -> None:
    rig = make_rig()
    table = CalibrationTable(archive=tmp_path / "empty")
    spec = rig.world.spec.model_copy(update={"calibration": table})

    def fail_to_open() -> Any:
        return open_head(spec, rig.clock, MemoryLedger(rig.clock))

    problem = problem_without_calibration(rig, fail_to_open)
    assert_text_is_complete("cal.missing", Observation("status", problem["code"]))
    assert "Calibrate the head" in problem["remedy"]


def test_a_head_with_another_diffuser_is_cal_mismatch(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.world.identity = HeadIdentity("D-7", "another-calibration")

    def fail_to_open() -> Any:
        head: Head = replace(rig.exam.head, chips=Chips(memory=SimHeadMemory(rig.world)))
        refuse_mismatched_head(head)
        raise AssertionError("the head was not refused")

    problem = problem_without_calibration(rig, fail_to_open)
    assert_text_is_complete("cal.mismatch", Observation("status", problem["code"]))
    assert "call the technician" in problem["remedy"]


def test_a_power_cut_in_a_picture_names_its_eye_and_part(build: Callable[..., Rig], tmp_path: Path) -> None:
    with ExitStack() as undo:
        rig = build(tmp_path / "before", undo)
        observed = faults.power_cut(rig, lambda: build(tmp_path / "after", undo), tmp_path / "after")
        assert_text_is_complete("power.lost", observed)
        until(lambda: not rig.exam.calibration_monitor.has_pending)


def test_stage_events_estimate_the_seconds_left(make_rig: MakeRig) -> None:
    left_s: dict[tuple[str, str], float] = {}  # by capture and stage, without the events between two stages

    class SlowBus(PressHookBus):
        """Event bus that delays each stage by one second, like a slow computer."""

        def publish(self, kind: str, **data: Any) -> None:
            super().publish(kind, **data)
            if kind == "stage" and data["stage"] != "refine" and (data["id"], data["stage"]) not in left_s:
                left_s[data["id"], data["stage"]] = data["left_s"]
                slow_rig.clock.sleep(1.0)

    slow_rig = make_rig(event_bus=SlowBus())
    for _ in range(2):
        slow_rig.exam.press("OD").result(30)
    assert list(left_s.values()) == pytest.approx([5.5, 5.0, 0.4, 3.5, 2.0, 1.0], abs=0.11)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "X-Controller": "stolen"}, 403),
        ({"X-Controller": "a script"}, 200),
        ({"Sec-Fetch-Site": "same-origin"}, 200),
        ({"Sec-Fetch-Site": "none"}, 200),
    ],
)
def test_a_cross_site_request_for_live_pictures_is_refused_without_light(
    old_rig: Rig, headers: dict[str, str], status: int
) -> None:
    faults.wait_until_idle(old_rig)
    old_rig.clock.elapsed_s += LEASE_S  # a request without a key needs a free control lease
    frames = old_rig.world.frames

    async def request_preview(client: httpx.AsyncClient) -> httpx.Response:
        del client.headers["Sec-Fetch-Site"]
        return await client.get("/api/preview?after=0", headers=headers)

    answer = old_rig.ask(request_preview)
    assert answer.status_code == status or (status, answer.status_code) == (200, 204)  # on a busy computer
    if status == 403:
        assert answer.json()["code"] == "link.forged"
        assert old_rig.world.frames == frames


def laterality_question(rig: Rig) -> dict[str, Any] | None:
    """Return the active laterality question of the status, or None."""
    standing = rig.request("GET", "/api/status").json()["standing"]
    return next((alert for alert in standing if alert["code"] == "eye.side"), None)


def answer_laterality(rig: Rig, capture: str, eye: str) -> dict[str, Any]:
    answer = rig.request("POST", f"/api/captures/{capture}/eye", json={"key": secrets.token_hex(8), "eye": eye})
    assert answer.status_code == 200, answer.text
    return dict(answer.json()["slots"])


def test_a_laterality_question_stands_until_it_is_answered(rig: Rig, equipped: tuple[Rig, DiskStub]) -> None:
    ledger = rig.exam.head.light.ledger
    kept = faults.other_eye(rig, equipped[1]).facts["id"]
    assert rig.store.get(kept).report.laterality.eye == "OS"
    assert laterality_question(rig) == {"code": "eye.side", "id": kept, "slot": "R-centre", "other": "OS"}
    answer_laterality(rig, kept, "OD")
    assert laterality_question(rig) is None
    rig.application.alerts.publish_changes()
    assert rig.published_events()[-1] == ("notice", {"code": "eye.side", "over": True})
    report = rig.store.get(kept).report
    assert (report.confirmed.eye, report.slot, report.moved) == ("OD", "R-centre", ())

    moved = faults.other_eye(rig, equipped[1]).facts["id"]
    rest = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    slots = answer_laterality(rig, moved, "OS")
    assert (slots["R-centre"]["state"], slots["L-centre"]["capture"]) == ("empty", moved)
    assert laterality_question(rig) is None
    dose = rig.store.get(moved).report.dose_j_per_cm2
    assert dose > 0
    moved_doses = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    assert moved_doses == (rest[0], pytest.approx(rest[1] + dose)), "the dose is added to the other eye as well"
    answer_laterality(rig, moved, "OD")
    answer_laterality(rig, moved, "OS")
    assert (ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")) == moved_doses, "the dose is added once per eye"


@pytest.mark.parametrize(("slot", "estimated"), [("R-centre", "OD"), ("L-centre", "OS"), ("R-nerve", None)])
def test_no_laterality_question_for_a_matching_eye(rig: Rig, slot: str, estimated: str | None) -> None:
    visit = asking.visit_with_consent(rig)["id"]
    eye = "OD" if slot[0] == "R" else "OS"
    assert asking.post_capture(rig, eye, visit=visit, slot=slot).code == "good"
    seen = rig.store.captures(1)[0].report.laterality
    assert (seen and seen.eye) == estimated
    assert laterality_question(rig) is None
