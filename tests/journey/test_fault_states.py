"""Every state of the page is reached by a fault of the simulated head, over the real server, whole with its numbers."""

import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from device.calibration.archive import Archive
from device.head import Chips, Head, open_bench, open_head, refuse_another_head
from device.ledger import MemoryLedger
from device.sim.chips import SimHeadMemory
from device.spec import CalibrationTable, load_head
from device.values import Identity
from services.instrument.api import create_app
from services.instrument.carrier import Https, SendSettings
from services.instrument.exam import Exam
from services.instrument.owner import Owner
from tests.journey import asking, faults
from tests.journey.asking import Attentive, Said, Shelf
from tests.journey.conftest import GateClock, MakeRig, Rig, builder, traced, until
from tests.receiver import receiving
from tests.simulated import SCENES, coarse
from tests.site import identity

K = 4  # pixels of the paper's sensor that are one here, k x k
WEB = Path(__file__).parents[2] / "web"
STATES = re.findall(r'"(\w+\.\w+)"', (WEB / "states.js").read_text().split("const TABLE = [")[1].split("].map(")[0])
SPOKEN = r'"state\.([\w.]+)": (?:\{\s*one: "(?:[^"]+)",\s*other: )?"([^"]+)"'
WORDS = dict(re.findall(SPOKEN, (WEB / "english.js").read_text()))
REFUSALS = {
    "camera.missing", "light.fault", "light.limit", "light.day", "store.full", "batt.empty", "heat.hot", "link.other",
    "lock.idle", "consent.missing", "consent.declined",
}  # fmt: skip


@pytest.fixture(scope="module")
def equipped(plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Shelf]]:
    """One instrument with thermometer, battery and a calibration with a date, for all scenarios in turn."""
    clock, build = GateClock(), builder(traced(coarse(load_head(SCENES / "calm.toml"), K)), plans)
    with ExitStack() as undo:
        folder = tmp_path_factory.mktemp("faults")
        papers = identity(folder)
        shelf = Shelf(receiver=undo.enter_context(receiving(*papers)))
        way = Https(SendSettings.model_validate(shelf.receiver.settings(folder, authority=papers[0])))
        made = {"head": asking.equipped, "store": {"free_bytes": shelf}, "clock": clock, "bulletin": Attentive()}
        yield build(folder, undo, **made, carrier=way), shelf


@pytest.fixture
def rig(equipped: tuple[Rig, Shelf]) -> Iterator[Rig]:
    rig, shelf = equipped
    began = rig.clock.start
    rig.app.state.notices.look()
    yield rig
    faults.mended(rig)
    shelf.free_bytes, shelf.asked, rig.clock.start = asking.MOST_BYTES, lambda: None, began
    rig.app.state.notices.look()


def says_what_its_words_need(code: str, said: Said) -> None:
    """The page's words for it are whole: every number that they mention was said."""
    assert faults.page_code(WEB, said.code) == code
    needed = set(re.findall(r"\{(\w+)\}", WORDS[code])) - {"part"} | ({"slot"} if "{part}" in WORDS[code] else set())
    assert needed <= said.facts.keys()
    if code in REFUSALS:
        assert len(said.remedy) > 20


@pytest.mark.parametrize("code", faults.SCENARIOS)
def test_a_fault_brings_its_state_about(code: str, rig: Rig, equipped: tuple[Rig, Shelf]) -> None:
    says_what_its_words_need(code, faults.SCENARIOS[code](rig, equipped[1]))


def test_every_state_of_the_page_has_its_scenario() -> None:
    assert len(STATES) == len(set(STATES)) >= 34
    reached = faults.SCENARIOS.keys() | faults.APART
    assert reached | faults.OF_THE_PAGE.keys() == set(STATES)
    assert len(reached) + len(faults.OF_THE_PAGE) == len(STATES)
    for file, test in faults.OF_THE_PAGE.values():
        assert f"def {test}(" in (WEB.parent / "tests" / "browser" / file).read_text()


def without_calibration(rig: Rig, wrong: Callable[[], Exam]) -> Any:
    """The status of an instrument whose head cannot be opened for pictures."""
    house = replace(rig.owner.house, archive=Archive(rig.store.folder / "nothing"))
    owner = Owner(house, wrong, lambda: open_bench(rig.world.spec, rig.clock))
    try:
        app = create_app(owner, rig.door)
        return replace(rig, owner=owner, app=app).request("GET", "/api/status").json()["problem"]
    finally:
        owner.stop()
        owner.close()


def test_a_head_that_was_never_calibrated_is_cal_missing(make_rig: MakeRig, tmp_path: Path) -> None:
    rig = make_rig()
    table = CalibrationTable(archive=tmp_path / "empty")
    spec = rig.world.spec.model_copy(update={"calibration": table})

    def opened() -> Any:
        return open_head(spec, rig.clock, MemoryLedger(rig.clock))

    problem = without_calibration(rig, opened)
    says_what_its_words_need("cal.missing", Said("status", problem["code"]))
    assert "Calibrate the head" in problem["remedy"]


def test_a_head_with_another_diffuser_is_cal_mismatch(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.world.identity = Identity("D-7", "another-calibration")

    def opened() -> Any:
        head: Head = replace(rig.exam.head, chips=Chips(memory=SimHeadMemory(rig.world)))
        refuse_another_head(head)
        raise AssertionError("it fits")

    problem = without_calibration(rig, opened)
    says_what_its_words_need("cal.mismatch", Said("status", problem["code"]))
    assert "call the technician" in problem["remedy"]


def test_a_power_cut_in_a_picture_names_its_eye_and_part(build: Callable[..., Rig], tmp_path: Path) -> None:
    with ExitStack() as undo:
        rig = build(tmp_path / "before", undo)
        said = faults.cut_off(rig, lambda: build(tmp_path / "after", undo), tmp_path / "after")
        says_what_its_words_need("power.lost", said)
        until(lambda: not rig.exam.fitness.due)


def test_stages_say_how_long_it_still_takes(make_rig: MakeRig) -> None:
    left_s: dict[tuple[str, str], float] = {}  # by capture and stage; between two stages pages hear more

    class Slow(Attentive):
        """Each stage takes a second more, as on a slow computer."""

        def tell(self, kind: str, **data: Any) -> None:
            super().tell(kind, **data)
            if kind == "stage" and data["stage"] != "refine" and (data["id"], data["stage"]) not in left_s:
                left_s[data["id"], data["stage"]] = data["left_s"]
                rig.clock.sleep(1.0)

    rig = make_rig(bulletin=Slow())
    for _ in range(2):
        rig.exam.press("OD").result(30)
    assert list(left_s.values()) == pytest.approx([5.2, 5.0, 0.4, 3.2, 2.0, 1.0], abs=0.11)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 403), ({"Sec-Fetch-Site": "cross-site"}, 403), ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "X-Controller": "stolen"}, 403), ({"X-Controller": "a script"}, 200),
        ({"Sec-Fetch-Site": "same-origin"}, 200), ({"Sec-Fetch-Site": "none"}, 200),
    ],
)  # fmt: skip
def test_the_lamp_shines_for_no_stranger(old_rig: Rig, headers: dict[str, str], status: int) -> None:
    faults.rest(old_rig)
    frames = old_rig.world.frames

    async def story(client: httpx.AsyncClient) -> httpx.Response:
        del client.headers["Sec-Fetch-Site"]
        return await client.get("/api/preview?after=0", headers=headers)

    answer = old_rig.ask(story)
    assert answer.status_code == status or (status, answer.status_code) == (200, 204)  # a busy computer
    if status == 403:
        assert answer.json()["code"] == "link.forged"
        assert old_rig.world.frames == frames


def asked(rig: Rig) -> dict[str, Any] | None:
    """What a page that was loaded anew is asked about the side of an eye."""
    standing = rig.request("GET", "/api/status").json()["standing"]
    return next((one for one in standing if one["code"] == "eye.side"), None)


def say(rig: Rig, capture: str, eye: str) -> dict[str, Any]:
    answer = rig.request("POST", f"/api/captures/{capture}/eye", json={"key": secrets.token_hex(8), "eye": eye})
    assert answer.status_code == 200, answer.text
    return dict(answer.json()["slots"])


def test_who_took_the_other_eye_is_asked_until_somebody_says_which_it_is(rig: Rig, equipped: tuple[Rig, Shelf]) -> None:
    ledger = rig.exam.head.light.ledger
    kept = faults.other_eye(rig, equipped[1]).facts["id"]
    assert rig.store.get(kept).report["laterality"]["eye"] == "OS"
    assert asked(rig) == {"code": "eye.side", "id": kept, "slot": "R-centre", "other": "OS"}
    say(rig, kept, "OD")
    assert asked(rig) is None
    rig.app.state.notices.look()
    assert rig.told()[-1] == ("notice", {"code": "eye.side", "over": True})
    report = rig.store.get(kept).report
    assert (report["confirmed"]["eye"], report["slot"], "moved" in report) == ("OD", "R-centre", False)

    moved = faults.other_eye(rig, equipped[1]).facts["id"]
    rest = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    slots = say(rig, moved, "OS")
    assert (slots["R-centre"]["state"], slots["L-centre"]["capture"]) == ("empty", moved)
    assert asked(rig) is None
    dose = rig.store.get(moved).report["dose_j_per_cm2"]
    assert dose > 0
    both = ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")
    assert both == (rest[0], pytest.approx(rest[1] + dose)), "the light went into the other eye, or into this one"
    say(rig, moved, "OD")
    say(rig, moved, "OS")
    assert (ledger.spent_j_per_cm2("OD"), ledger.spent_j_per_cm2("OS")) == both, "each eye has it once"


@pytest.mark.parametrize(("slot", "said"), [("R-centre", "OD"), ("L-centre", "OS"), ("R-nerve", None)])
def test_the_eye_that_was_asked_for_comes_and_nobody_is_asked(rig: Rig, slot: str, said: str | None) -> None:
    visit = asking.agreed_visit(rig)["id"]
    eye = "OD" if slot[0] == "R" else "OS"
    assert asking.pressed(rig, eye, visit=visit, slot=slot).code == "good"
    report = rig.store.captures(1)[0].report
    assert (report["laterality"] or {}).get("eye") == said
    assert asked(rig) is None
